"""ViT-T: a transformer over the patches of a frame, one over time, an action head.

Shape legend: B batch, T time, M tokens per step, S token of a patch, E token of a step.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from lifelong.errors import PolicyError
from lifelong.nn.heads import GMMHead
from lifelong.nn.tokens import LanguageToken
from lifelong.nn.transformer import SpatialTransformer, TemporalTransformer
from lifelong.nn.vision import PatchEncoder
from lifelong.policies.history import Component, Head, OverTime, Readout, TokenPolicy
from lifelong.types import CompletedWith, Observation, PolicySpec, Share, Width

Patches = Annotated[Component, CompletedWith(("image_size", "dim"))]
OverPatches = Annotated[Component, CompletedWith(("views", "patches", "dim", "out_dim"))]


class BCViLT(TokenPolicy):
    """Behaviour cloning with LIBERO's ViT-T (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    Each time step becomes M tokens: the instruction, one per proprioceptive modality, and one in which a transformer
    has mixed the patches of all cameras with the instruction. Time is treated as in `BCTransformer`. The defaults are
    the paper's sizes: with a 768-d embedding, two cameras of 128 x 128 and two modalities it has 7 917 963
    parameters, as the original.

    Args:
        spec: What the policy observes and does; `spec.seq_len` is the longest history.
        patch_embed: S, the size of a patch's token.
        embed_dim: E, the size of a step's token.
        encoder: Patches of an image, one encoder for each camera, see `PatchEncoder`; completed with `image_size` and
            `dim`.
        spatial: Network over the patches of a frame, see `SpatialTransformer`; completed with `views`, `patches`,
            `dim` and `out_dim`.
        temporal: Network over time, see `TemporalTransformer`; completed with `dim` and `max_length`.
        head: Action head: `GMMHead`, `DeterministicHead` or `FlowHead`; completed with `in_dim` and `action_dim`.
        readout: What the head reads: the instruction's token alone, or all of the frame's beside it, see `TokenPolicy`.
        stochastic: See `HistoryPolicy`.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring the numbers of an embedding to mean 0 and deviation 1.

    Raises:
        PolicyError: Components or sizes that do not work together, or no camera.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        patch_embed: Width = 128,
        embed_dim: Width = 64,
        encoder: Patches = PatchEncoder,
        spatial: OverPatches = SpatialTransformer,
        temporal: OverTime = TemporalTransformer,
        head: Head = GMMHead,
        readout: Readout = "instruction",
        stochastic: bool = False,
        normalise_proprio: bool = True,
        proprio_dropout: Share = 0.0,
        standardise_language: bool = True,
    ) -> None:
        super().__init__(spec, stochastic=stochastic, standardise_language=standardise_language)
        if not spec.views:
            raise PolicyError("data.views is []; this policy sees nothing without a camera")
        encoders = {view: encoder(image_size=spec.image_size, dim=patch_embed) for view in spec.views}
        self.encoders = nn.ModuleDict(encoders)
        self.spatial_language = LanguageToken(language_dim=spec.language_dim, dim=patch_embed)
        patches = encoders[spec.views[0]].patches
        self.spatial = spatial(views=len(encoders), patches=patches, dim=patch_embed, out_dim=embed_dim)
        self.build_rest(("images",), embed_dim, temporal, head, readout, normalise_proprio, proprio_dropout)

    def encode(self, observation: Observation) -> Tensor:
        """Return the tokens of every time step, (B, T, M, E); each step by itself."""
        images, language = observation.images, self.instruction(observation)
        patches = [
            encoder(images[:, :, view].flatten(0, 1)) for view, encoder in enumerate(self.encoders.values())
        ]
        seen = self.spatial(torch.stack(patches, dim=1), self.spatial_language(language))
        seen = seen.view(*images.shape[:2], -1)
        return torch.stack([*self.tokens_beside(observation, language), seen], dim=2)
