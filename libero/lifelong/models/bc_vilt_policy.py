"""ViT-T under the original's names; see `lifelong.policies.bc_vilt`."""

from typing import Any

from libero.lifelong.models.bc_transformer_policy import deepen_tokens
from libero.lifelong.models.modules.extra_modules import ExtraModalityTokens
from libero.lifelong.models.modules.rgb_modules import square
from libero.lifelong.models.native_policy import (
    NativePolicy,
    build_language,
    encode_positions,
    temporal_sizes,
)
from lifelong.errors import PolicyError
from lifelong.policies import BCViLT

__all__ = ["BCViLTPolicy", "ExtraModalityTokens"]


class BCViLTPolicy(NativePolicy):
    """A transformer over the patches of a frame, and one over time."""

    def _network(self, policy: Any, more: dict[str, Any]) -> BCViLT:
        patches, embed_size = policy.image_encoder, policy.embed_size
        if patches.network != "PatchEncoder":
            raise PolicyError(f"image_encoder is {patches.network}; this policy looks through a PatchEncoder")
        if policy.spatial_transformer_dropout != policy.transformer_dropout:
            raise PolicyError("spatial_transformer_dropout and transformer_dropout must be equal")
        token = policy.spatial_down_sample_embed_size if policy.spatial_down_sample else embed_size
        sizes = {
            "patch_embed": embed_size,
            "patch": square(patches.network_kwargs.patch_size),
            "spatial_layers": policy.spatial_transformer_num_layers,
            "spatial_heads": policy.spatial_transformer_num_heads,
            "spatial_head_dim": policy.spatial_transformer_head_output_size,
            "spatial_mlp_dim": policy.spatial_transformer_mlp_hidden_size,
            "embed_dim": token,
            **temporal_sizes(policy, token),
        }
        network = self._build(BCViLT, {**sizes, **more})
        encode_positions(network, policy)
        network.language.linear = build_language(policy, "a token", token)  # type: ignore[assignment]
        network.spatial_language.linear = build_language(  # type: ignore[assignment]
            policy, "the spatial transformer", embed_size
        )
        deepen_tokens(network, policy, token)
        return network
