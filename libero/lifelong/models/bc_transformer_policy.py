"""ResNet-T under the original's name; see `lifelong.policies.bc_transformer`."""

from typing import Any

from libero.lifelong.models.modules.extra_modules import ExtraModalityTokens
from libero.lifelong.models.native_policy import NativePolicy, resnet_sizes, temporal_sizes
from libero.lifelong.models.saliency import PerturbationAttention
from lifelong.policies import BCTransformer


class BCTransformerPolicy(NativePolicy):
    """Tokens of language, proprioception and cameras at each step, and a transformer over time."""

    kind = BCTransformer

    def _arguments(self, policy: Any) -> dict[str, Any]:
        size = policy.embed_size
        return {"embed_dim": size, **resnet_sizes(policy), **temporal_sizes(policy, size)}
