"""ResNet-T: ResNet with FiLM per camera, a transformer over time, a mixture of Gaussians over actions.

Shape legend: B batch, T time, V views, M tokens per step, E token, A action, L language embedding.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lifelong.nn.tokens import LanguageToken, ProprioTokens, standardise
from lifelong.nn.transformer import TemporalTransformer
from lifelong.nn.vision import ResNetFiLMEncoder
from lifelong.policies.history import HistoryPolicy, make_head
from lifelong.types import Observation, PolicySpec


class BCTransformer(HistoryPolicy):
    """Behaviour cloning with LIBERO's ResNet-T (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    Each time step becomes M tokens: the instruction, one per proprioceptive modality, one per camera. All
    tokens of a step see each other and everything earlier; the action is read from the instruction's token.
    The defaults are the paper's sizes: with a 768-d embedding, two cameras and two modalities it has
    5 383 307 parameters, as the original.

    Args:
        spec: what the policy sees and does; `spec.seq_len` is the longest history.
        embed_dim: E, also the size of an image's latent.
        image_width, stage_blocks, stem_kernel, stem_stride, stem_pool, keypoints, keypoint_temperature, readout, norm:
            image encoder, see `ResNetFiLMEncoder`. Each camera has its own.
        layers, heads, head_dim, mlp_dim, dropout: transformer, see `TemporalTransformer`.
        head: `gmm`, `deterministic` or `flow`.
        head_hidden, head_layers, head_norm, modes, min_std, low_eval_noise: see `GMMHead`.
        chunk, execute, flow_steps: of the `flow` head, see `FlowHead`, which takes hidden and layers as well.
        stochastic: sample actions instead of taking the most likely one; needs generators to act.
        normalise_proprio, proprio_dropout: see `ProprioTokens`.
        standardise_language: bring embeddings to mean 0 and variance 1, so that unit vectors of sentence
            encoders weigh as much as BERT's outputs.

    Raises:
        PolicyError: an unknown head or norm, or sizes that cannot work.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        embed_dim: int = 64,
        image_width: int = 64,
        stage_blocks: Sequence[int] = (2, 2),
        stem_kernel: int = 7,
        stem_stride: int = 2,
        stem_pool: bool = True,
        keypoints: int | None = None,
        keypoint_temperature: float = 1.0,
        readout: str = "keypoints",
        norm: str = "group",
        layers: int = 4,
        heads: int = 6,
        head_dim: int = 64,
        mlp_dim: int = 256,
        dropout: float = 0.1,
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
        self.standardise_language = standardise_language
        self.encoders = nn.ModuleDict(
            {
                view: ResNetFiLMEncoder(
                    image_size=spec.image_size,
                    language_dim=spec.language_dim,
                    latent_dim=embed_dim,
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
        self.language = LanguageToken(language_dim=spec.language_dim, dim=embed_dim)
        self.proprio = ProprioTokens(
            proprio=spec.proprio, dim=embed_dim, normalise=normalise_proprio, dropout=proprio_dropout
        )
        self.transformer = TemporalTransformer(
            dim=embed_dim,
            layers=layers,
            heads=heads,
            head_dim=head_dim,
            mlp_dim=mlp_dim,
            dropout=dropout,
            max_length=spec.seq_len,
        )
        self.head = make_head(
            head,
            spec=spec,
            in_dim=embed_dim,
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

    def encode(self, observation: Observation) -> Tensor:
        """The tokens of every time step, (B, T, M, E); each step by itself."""
        images, language = observation.images, observation.language
        b, t = images.shape[:2]
        if self.standardise_language:
            language = standardise(language)
        tokens = [self.language(language)[:, None, None].expand(b, t, 1, -1)]
        if self.spec.proprio:
            tokens.append(self.proprio(observation.proprio))
        for view, encoder in enumerate(self.encoders.values()):
            latent = encoder(images[:, :, view].flatten(0, 1), language)
            tokens.append(latent.view(b, t, 1, -1))
        return torch.cat(tokens, dim=2)

    def over_time(self, features: Tensor) -> Tensor:
        """Tokens (B, T, M, E) to the instruction's latent at every step, (B, T, E)."""
        return self.transformer(features)[:, :, 0]
