"""ResNet-RNN: ResNet with FiLM per camera, an LSTM over time, an action head.

Shape legend: B batch, T time, F features of a frame, A action, L language embedding.
"""

from typing import Annotated, Literal

from torch import Tensor, nn

from lifelong.nn.heads import GMMHead
from lifelong.nn.transformer import TemporalLSTM
from lifelong.nn.vision import ResNetFiLMEncoder
from lifelong.policies.history import Component, Head, ImageEncoder, VectorPolicy
from lifelong.types import CompletedWith, PolicySpec, Share, Width


class BCRNN(VectorPolicy):
    """Behaviour cloning with LIBERO's ResNet-RNN (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    The cameras' latents, the instruction's latent and the proprioceptive readings are joined to one vector per frame
    and go through an LSTM. The defaults are the paper's sizes: with a 768-d embedding, two cameras, joints and
    gripper it has 19 105 707 parameters, as the original.

    Args:
        spec: What the policy observes and does; `spec.seq_len` is the longest history.
        image_embed: Size of a camera's latent.
        text_embed: Size of the instruction's latent.
        encoder: Image encoder, one for each camera, see `ResNetFiLMEncoder`; completed with `image_size`,
            `language_dim` and `latent_dim`.
        temporal: Network over time, see `TemporalLSTM`; completed with `in_dim`.
        head: Action head: `GMMHead`, `DeterministicHead` or `FlowHead`; completed with `in_dim` and `action_dim`.
        memory: What the LSTM remembers when acting. Windows in training start with an empty state, so it must not
            grow older than they are. `reset`: the state is carried on and emptied every `seq_len` steps; the steps
            after that hardly know the past. `window`: the LSTM reads the last `seq_len` frames again at every step.
            `none`: the state is empty at every step, as where the original acts; each action follows from one frame.
        stochastic: See `HistoryPolicy`.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring the numbers of an embedding to mean 0 and deviation 1.

    Raises:
        PolicyError: Components or sizes that do not work together.
    """

    uses_history = True

    def __init__(
        self,
        *,
        spec: PolicySpec,
        image_embed: Width = 64,
        text_embed: Width = 32,
        encoder: ImageEncoder = ResNetFiLMEncoder,
        temporal: Annotated[Component, CompletedWith(("in_dim",))] = TemporalLSTM,
        head: Head = GMMHead,
        memory: Literal["reset", "window", "none"] = "reset",
        stochastic: bool = False,
        normalise_proprio: bool = True,
        proprio_dropout: Share = 0.0,
        standardise_language: bool = True,
    ) -> None:
        super().__init__(spec, stochastic=stochastic, standardise_language=standardise_language)
        size = self.build_inputs(encoder, image_embed, text_embed, normalise_proprio, proprio_dropout)
        self.memory = memory
        self.rnn: nn.LSTM = temporal(in_dim=size)
        self.head = self.build_head(head, in_dim=self.rnn.hidden_size)
        self._state: tuple[Tensor, Tensor] | None = None  # each (layers, B, hidden)
        self._age = 0  # steps that the state has seen

    def over_time(self, features: Tensor) -> Tensor:
        """Map features (B, T, F) to the LSTM's outputs, (B, T, hidden), from an empty state."""
        return self.rnn(features)[0]

    def reset(self, num_envs: int) -> None:
        """Forget the history and the LSTM's state; see `Policy`."""
        super().reset(num_envs)
        self._state, self._age = None, 0

    def _latest_latent(self, features: Tensor) -> Tensor:
        if self.memory == "window":
            return super()._latest_latent(features)
        if self.memory == "none":
            return self.over_time(features)[:, -1]
        if self._age == self.memory_steps:
            self._state, self._age = None, 0
        latent, self._state = self.rnn(features, self._state)
        self._age += 1
        return latent[:, -1]
