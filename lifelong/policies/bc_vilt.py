"""ViT-T: a transformer over the patches of a frame, one over time, a mixture of Gaussians over actions.

Shape legend: B batch, T time, V views, P patches, M tokens per step, S token of a patch, E token of a step.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.patches import PatchEncoder, SpatialTransformer
from lifelong.nn.tokens import LanguageToken, ProprioTokens, standardise
from lifelong.nn.transformer import TemporalTransformer
from lifelong.policies.history import HistoryPolicy, make_head
from lifelong.types import Observation, PolicySpec


class BCViLT(HistoryPolicy):
    """Behaviour cloning with LIBERO's ViT-T (Liu et al., NeurIPS 2023, section 4.2 and appendix A).

    Each time step becomes M tokens: the instruction, one per proprioceptive modality, and one in which a transformer
    has put together the patches of all cameras and the instruction. Time is treated as in `BCTransformer`. The
    defaults are the paper's sizes: with a 768-d embedding, two cameras of 128 x 128 and two modalities it has
    7 917 963 parameters, as the original.

    Args:
        spec: what the policy sees and does; `spec.seq_len` is the longest history.
        patch_embed: S.
        patch_width, stem_kernel, stem_stride, patch, norm: see `PatchEncoder`. Each camera has its own.
        spatial_layers, spatial_heads, spatial_head_dim, spatial_mlp_dim: see `SpatialTransformer`.
        embed_dim: E.
        layers, heads, head_dim, mlp_dim: see `TemporalTransformer`.
        dropout: of both transformers.
        head: `gmm`, `deterministic` or `flow`.
        head_hidden, head_layers, head_norm, modes, min_std, low_eval_noise: see `GMMHead`.
        chunk, execute, flow_steps: of the `flow` head, see `FlowHead`, which takes hidden and layers as well.
        stochastic: sample actions instead of taking the most likely one; needs generators to act.
        normalise_proprio, proprio_dropout: see `ProprioScaling`.
        standardise_language: bring embeddings to mean 0 and variance 1.

    Raises:
        PolicyError: an unknown head or norm, or sizes that cannot work.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        patch_embed: int = 128,
        patch_width: int = 64,
        stem_kernel: int = 7,
        stem_stride: int = 2,
        patch: int = 8,
        norm: str = "group",
        spatial_layers: int = 7,
        spatial_heads: int = 8,
        spatial_head_dim: int = 120,
        spatial_mlp_dim: int = 256,
        embed_dim: int = 64,
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
                view: PatchEncoder(
                    image_size=spec.image_size,
                    dim=patch_embed,
                    width=patch_width,
                    stem_kernel=stem_kernel,
                    stem_stride=stem_stride,
                    patch=patch,
                    norm=norm,
                )
                for view in spec.views
            }
        )
        self.spatial_language = LanguageToken(language_dim=spec.language_dim, dim=patch_embed)
        self.spatial = SpatialTransformer(
            views=len(spec.views),
            patches=self.encoders[spec.views[0]].patches,
            dim=patch_embed,
            out_dim=embed_dim,
            layers=spatial_layers,
            heads=spatial_heads,
            head_dim=spatial_head_dim,
            mlp_dim=spatial_mlp_dim,
            dropout=dropout,
        )
        self.language = LanguageToken(language_dim=spec.language_dim, dim=embed_dim)
        self.proprio = ProprioTokens(
            proprio=spec.proprio or {}, dim=embed_dim, normalise=normalise_proprio, dropout=proprio_dropout
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
        patches = [
            encoder(images[:, :, view].flatten(0, 1)) for view, encoder in enumerate(self.encoders.values())
        ]
        seen = self.spatial(torch.stack(patches, dim=1), self.spatial_language(language))
        tokens = [self.language(language)[:, None, None].expand(b, t, 1, -1)]
        if self.spec.proprio:
            tokens.append(self.proprio(observation.proprio))
        return torch.cat([*tokens, seen.view(b, t, 1, -1)], dim=2)

    def over_time(self, features: Tensor) -> Tensor:
        """Tokens (B, T, M, E) to the instruction's latent at every step, (B, T, E)."""
        return self.transformer(features)[:, :, 0]
