"""ResNet-RNN: ResNet with FiLM per camera, an LSTM over time, a mixture of Gaussians over actions.

Shape legend: B batch, T time, F features of a frame, A action, L language embedding.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lifelong.errors import PolicyError
from lifelong.nn.tokens import LanguageToken, ProprioScaling, standardise
from lifelong.nn.vision import ResNetFiLMEncoder
from lifelong.policies.history import HistoryPolicy, make_head
from lifelong.types import Observation, PolicySpec


class BCRNN(HistoryPolicy):
    """Behaviour cloning with LIBERO's ResNet-RNN (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    Latents of the cameras, the instruction's and the proprioceptive readings are joined to one vector per frame and
    go through an LSTM. The defaults are the paper's sizes: with a 768-d embedding, two cameras, joints and gripper it
    has 19 105 707 parameters, as the original.

    Args:
        spec: what the policy sees and does; `spec.seq_len` is the longest history.
        image_embed, text_embed: sizes of a camera's and of the instruction's latent.
        image_width, stage_blocks, stem_kernel, stem_stride, stem_pool, keypoints, keypoint_temperature, readout, norm:
            image encoder, see `ResNetFiLMEncoder`. Each camera has its own.
        rnn_hidden, rnn_layers, dropout: of the LSTM; dropout between its layers.
        memory: what is remembered when acting; windows in training start with an empty memory, so that it must not
            grow older than they are. `reset`: the state is carried, and emptied every `seq_len` steps, as in the
            original; the steps after that act nearly blind to the past. `window`: the LSTM reads the last `seq_len`
            frames anew at every step.
        head: `gmm`, `deterministic` or `flow`.
        head_hidden, head_layers, head_norm, modes, min_std, low_eval_noise: see `GMMHead`.
        chunk, execute, flow_steps: of the `flow` head, see `FlowHead`, which takes hidden and layers as well.
        stochastic: sample actions instead of taking the most likely one; needs generators to act.
        normalise_proprio, proprio_dropout: see `ProprioScaling`.
        standardise_language: bring embeddings to mean 0 and variance 1.

    Raises:
        PolicyError: an unknown head, memory or norm, or sizes that cannot work.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        image_embed: int = 64,
        text_embed: int = 32,
        image_width: int = 64,
        stage_blocks: Sequence[int] = (2, 2),
        stem_kernel: int = 7,
        stem_stride: int = 2,
        stem_pool: bool = True,
        keypoints: int | None = None,
        keypoint_temperature: float = 1.0,
        readout: str = "keypoints",
        norm: str = "group",
        rnn_hidden: int = 1024,
        rnn_layers: int = 2,
        dropout: float = 0.0,
        memory: str = "reset",
        head: str = "gmm",
        head_hidden: int = 1024,
        head_layers: int = 2,
        head_norm: bool = False,
        modes: int = 5,
        min_std: float = 1e-4,
        low_eval_noise: bool = False,
        chunk: int = 5,
        execute: int = 3,
        flow_steps: int = 10,
        stochastic: bool = False,
        normalise_proprio: bool = True,
        proprio_dropout: float = 0.0,
        standardise_language: bool = True,
    ) -> None:
        super().__init__(spec, stochastic=stochastic)
        if memory not in ("reset", "window"):
            raise PolicyError(f"unknown memory {memory!r}. Valid: reset, window")
        self.memory, self.standardise_language = memory, standardise_language
        self.encoders = nn.ModuleDict(
            {
                view: ResNetFiLMEncoder(
                    image_size=spec.image_size,
                    language_dim=spec.language_dim,
                    latent_dim=image_embed,
                    width=image_width,
                    stage_blocks=stage_blocks,
                    stem_kernel=stem_kernel,
                    stem_stride=stem_stride,
                    stem_pool=stem_pool,
                    keypoints=keypoints,
                    temperature=keypoint_temperature,
                    readout=readout,
                    norm=norm,
                )
                for view in spec.views
            }
        )
        self.language = LanguageToken(language_dim=spec.language_dim, dim=text_embed)
        readings = spec.proprio or {}
        self.proprio = ProprioScaling(proprio=readings, normalise=normalise_proprio, dropout=proprio_dropout)
        self.rnn = nn.LSTM(
            input_size=image_embed * len(spec.views) + text_embed + sum(readings.values()),
            hidden_size=rnn_hidden,
            num_layers=rnn_layers,
            dropout=dropout if rnn_layers > 1 else 0.0,
            batch_first=True,
        )
        self.head = make_head(
            head,
            spec=spec,
            in_dim=rnn_hidden,
            hidden=head_hidden,
            layers=head_layers,
            norm=head_norm,
            modes=modes,
            min_std=min_std,
            low_eval_noise=low_eval_noise,
            chunk=chunk,
            execute=execute,
            flow_steps=flow_steps,
        )
        self._state: tuple[Tensor, Tensor] | None = None  # each (layers, B, hidden)
        self._age = 0  # steps that the state has seen

    def encode(self, observation: Observation) -> Tensor:
        """One vector per frame, (B, T, F)."""
        images, language = observation.images, observation.language
        b, t = images.shape[:2]
        if self.standardise_language:
            language = standardise(language)
        parts = [
            encoder(images[:, :, view].flatten(0, 1), language).view(b, t, -1)
            for view, encoder in enumerate(self.encoders.values())
        ]
        parts.append(self.language(language)[:, None].expand(b, t, -1))
        parts += self.proprio(observation.proprio).values()
        return torch.cat(parts, dim=-1)

    def over_time(self, features: Tensor) -> Tensor:
        """(B, T, F) to the LSTM's outputs, (B, T, hidden), from an empty memory."""
        return self.rnn(features)[0]

    def reset(self, num_envs: int) -> None:
        """See `Policy`."""
        super().reset(num_envs)
        self._state, self._age = None, 0

    def _recall(self, features: Tensor) -> Tensor:
        if self.memory == "window":
            return super()._recall(features)
        if self._age == self.memory_steps:
            self._state, self._age = None, 0
        latent, self._state = self.rnn(features, self._state)
        self._age += 1
        return latent[:, -1]
