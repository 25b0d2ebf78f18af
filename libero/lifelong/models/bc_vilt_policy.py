"""ViT-T under the original's name; see `lifelong.policies.bc_vilt`."""

from typing import Any

from libero.lifelong.models.modules.extra_modules import ExtraModalityTokens
from libero.lifelong.models.modules.rgb_modules import square
from libero.lifelong.models.native_policy import NativePolicy, temporal_sizes
from lifelong.errors import PolicyError
from lifelong.policies import BCViLT


class BCViLTPolicy(NativePolicy):
    """A transformer over the patches of a frame, and one over time."""

    kind = BCViLT

    def _arguments(self, policy: Any) -> dict[str, Any]:
        patches, size = policy.image_encoder, policy.embed_size
        if patches.network != "PatchEncoder":
            raise PolicyError(f"image_encoder is {patches.network}; this policy needs a PatchEncoder")
        if policy.spatial_transformer_dropout != policy.transformer_dropout:
            raise PolicyError("spatial_transformer_dropout and transformer_dropout must be equal")
        token = policy.spatial_down_sample_embed_size if policy.spatial_down_sample else size
        return {
            "patch_embed": size,
            "patch": square(patches.network_kwargs.patch_size),
            "spatial_layers": policy.spatial_transformer_num_layers,
            "spatial_heads": policy.spatial_transformer_num_heads,
            "spatial_head_dim": policy.spatial_transformer_head_output_size,
            "spatial_mlp_dim": policy.spatial_transformer_mlp_hidden_size,
            "embed_dim": token,
            **temporal_sizes(policy, token),
        }
