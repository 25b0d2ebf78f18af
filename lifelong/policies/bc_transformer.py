"""ResNet-T: ResNet with FiLM per camera, a transformer over time, an action head.

Shape legend: B batch, T time, M tokens per step, E token.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.heads import GMMHead
from lifelong.nn.transformer import TemporalTransformer
from lifelong.nn.vision import ResNetFiLMEncoder, encode_views
from lifelong.policies.history import Head, ImageEncoder, OverTime, Readout, TokenPolicy
from lifelong.types import Observation, PolicySpec, Share, Width


class BCTransformer(TokenPolicy):
    """Behaviour cloning with LIBERO's ResNet-T (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    Each time step becomes M tokens: the instruction, one per proprioceptive modality, one per camera. All tokens of a
    step attend to each other and to everything earlier; the action is read from the instruction's token. The defaults
    are the paper's sizes: with a 768-d embedding, two cameras and two modalities it has 5 383 307 parameters, as the
    original.

    Args:
        spec: What the policy observes and does; `spec.seq_len` is the longest history.
        embed_dim: E, also the size of an image's latent.
        encoder: Image encoder, one for each camera, see `ResNetFiLMEncoder`; completed with `image_size`,
            `language_dim` and `latent_dim`.
        temporal: Network over time, see `TemporalTransformer`; completed with `dim` and `max_length`.
        head: Action head: `GMMHead`, `DeterministicHead` or `FlowHead`; completed with `in_dim` and `action_dim`.
        readout: What the head reads: the instruction's token alone, or all of the frame's beside it, see `TokenPolicy`.
        stochastic: See `HistoryPolicy`.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring the numbers of an embedding to mean 0 and deviation 1.

    Raises:
        PolicyError: Components or sizes that do not work together.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        embed_dim: Width = 64,
        encoder: ImageEncoder = ResNetFiLMEncoder,
        temporal: OverTime = TemporalTransformer,
        head: Head = GMMHead,
        readout: Readout = "instruction",
        stochastic: bool = False,
        normalise_proprio: bool = True,
        proprio_dropout: Share = 0.0,
        standardise_language: bool = True,
    ) -> None:
        super().__init__(spec, stochastic=stochastic, standardise_language=standardise_language)
        sizes = {"image_size": spec.image_size, "language_dim": spec.language_dim, "latent_dim": embed_dim}
        self.encoders = nn.ModuleDict({view: encoder(**sizes) for view in spec.views})
        self.build_rest(spec.views, embed_dim, temporal, head, readout, normalise_proprio, proprio_dropout)

    def encode(self, observation: Observation) -> Tensor:
        """Return the tokens of every time step, (B, T, M, E); each step by itself."""
        language = self.instruction(observation)
        tokens = self.tokens_beside(observation, language)
        return torch.stack([*tokens, *encode_views(self.encoders, observation.images, language)], dim=2)
