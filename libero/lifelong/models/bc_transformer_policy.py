"""ResNet-T under the original's names; see `lifelong.policies.bc_transformer`."""

from typing import Any

from libero.lifelong.models.modules.extra_modules import ExtraModalityTokens
from libero.lifelong.models.modules.language_modules import mlp
from libero.lifelong.models.native_policy import (
    NativePolicy,
    build_language,
    encode_positions,
    fuse_all,
    image_sizes,
    temporal_sizes,
)
from libero.lifelong.models.saliency import PerturbationAttention
from lifelong.policies import BCTransformer

__all__ = ["BCTransformerPolicy", "ExtraModalityTokens", "PerturbationAttention"]


class BCTransformerPolicy(NativePolicy):
    """Language, readings and cameras as tokens of a step, and a transformer over time."""

    def _network(self, policy: Any, more: dict[str, Any]) -> BCTransformer:
        sizes = {
            "embed_dim": policy.embed_size,
            **image_sizes(policy),
            **temporal_sizes(policy, policy.embed_size),
        }
        network = self._build(BCTransformer, {**sizes, **more})
        fuse_all(network, policy)
        encode_positions(network, policy)
        network.language.linear = build_language(policy, "a token", policy.embed_size)  # type: ignore[assignment]
        deepen_tokens(network, policy, policy.embed_size)
        return network


def deepen_tokens(network: Any, policy: Any, embed_size: int) -> None:
    """MLPs of `extra_num_layers` hidden layers instead of linear maps of the readings."""
    for name, linear in network.proprio.linears.items() if policy.extra_num_layers else ():
        layers = policy.extra_num_layers + 1
        network.proprio.linears[name] = mlp(linear.in_features, policy.extra_hidden_size, layers, embed_size)
