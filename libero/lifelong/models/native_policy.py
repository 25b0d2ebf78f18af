"""Policies whose network is one of `lifelong.policies`, under the original's methods and sizes.

Shape legend: B batch, T time, M tokens per time step, E token, A action.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor, nn

from libero._adapters.lifelong.config import lookup, plain
from libero._adapters.lifelong.observations import policy_spec, to_native
from libero.lifelong.models.base_policy import BasePolicy
from libero.lifelong.models.modules.language_modules import ENCODERS
from libero.lifelong.models.modules.rgb_modules import fuse, resnet_sizes
from libero.lifelong.models.policy_head import HEADS, GMMHead, check_activation, head_over
from lifelong.build import build
from lifelong.errors import PolicyError
from lifelong.nn.transformer import sinusoidal_positions
from lifelong.policies.history import HistoryPolicy
from lifelong.saved_config import upgrade_policy
from lifelong.types import Observation


class NativePolicy(BasePolicy, registered=False):
    """A `HistoryPolicy`, held as `network`; its checkpoints and this one's weights are interchangeable.

    `cfg.policy.native` holds further arguments of the network, as flat keys (see `upgrade_policy`). With `norm: batch`,
    `normalise_proprio: false` and `standardise_language: false` it is the original's to the letter.

    Raises:
        PolicyError: a configuration that these networks cannot follow.
    """

    network: Any  # a HistoryPolicy

    def __init__(self, cfg: Any, shape_meta: Mapping[str, Any]):
        super().__init__(cfg, shape_meta)
        policy = cfg.policy
        self.max_seq_len = int(policy.get("transformer_max_seq_len") or cfg.data.seq_len)
        self.spec = policy_spec(cfg, shape_meta, self.max_seq_len)
        self.network: HistoryPolicy = self._network(
            policy, {**_head(policy), **plain(policy.get("native") or {})}
        )
        object.__setattr__(self, "policy_head", head_over(self.network.head, _loss_coef(policy)))
        self.latent_queue: list[Tensor] = []

    @abstractmethod
    def _network(self, policy: Any, more: dict[str, Any]) -> HistoryPolicy:
        """The network, from `cfg.policy` and what stands in every policy's configuration."""

    def _build(self, kind: type[HistoryPolicy], arguments: Mapping[str, Any]) -> Any:
        """Return a network of this class, its components given by flat arguments such as `head_hidden`."""
        node = upgrade_policy({"_target_": f"{kind.__module__}.{kind.__name__}", **arguments})
        return build(OmegaConf.create(node), spec=self.spec)

    def spatial_encode(self, data: Mapping[str, Any]) -> Tensor:
        """What each frame shows, by itself: (B, T, M, E), or (B, T, E) for the RNN."""
        return self.network.encode(self._observation(data))

    def temporal_encode(self, x: Tensor) -> Tensor:
        """(B, T, M, E) -> (B, T, E), each step from its own frame and earlier ones."""
        return self.network.over_time(x)

    def forward(self, data: Mapping[str, Any]) -> Any:
        """The distribution of actions (B, T, A)."""
        return self.policy_head(self.temporal_encode(self.spatial_encode(data)))

    def get_action(self, data: Mapping[str, Any]) -> np.ndarray:
        """Actions (B, A), drawn with torch's global generator."""
        self.eval()
        with torch.no_grad():
            dist = self.policy_head(self._latest(self.preprocess_input(data, train_mode=False)))
            action = dist if isinstance(dist, Tensor) else dist.sample()
        return action.clamp(-1, 1).cpu().numpy()

    def reset(self) -> None:
        """See `BasePolicy`."""
        self.latent_queue = []

    def _latest(self, data: Mapping[str, Any]) -> Tensor:
        """Takes a frame in; its latent (B, E) with those of the last frames in view."""
        self.latent_queue = [*self.latent_queue, self.spatial_encode(data)][-self.max_seq_len :]
        return self.temporal_encode(torch.cat(self.latent_queue, dim=1))[:, -1]

    def _observation(self, data: Mapping[str, Any]) -> Observation:
        return to_native(data["obs"], data["task_emb"], self.spec)


def build_language(policy: Any, kind: str, output_size: int) -> nn.Module:
    """The encoder that the configuration names, from embeddings to `output_size` numbers.

    Raises:
        PolicyError: the embedding goes in as it is and has another size.
    """
    node = policy.language_encoder
    kwargs = plain(node.network_kwargs)
    if node.network == "IdentityEncoder" and kwargs["input_size"] != output_size:
        raise PolicyError(
            f"IdentityEncoder gives {kwargs['input_size']} numbers, {kind} takes {output_size}: make them equal, or "
            "use policy/language_encoder=mlp_encoder"
        )
    if node.network != "IdentityEncoder":
        kwargs["output_size"] = output_size
    return lookup(ENCODERS, "language encoder", node.network)(**kwargs)


def image_sizes(policy: Any) -> dict[str, Any]:
    """Arguments of a network with a ResNet for each camera.

    Raises:
        PolicyError: another encoder, or sizes that cannot work.
    """
    node = policy.image_encoder
    if node.network != "ResnetEncoder":
        raise PolicyError(f"image_encoder is {node.network}; this policy looks through a ResnetEncoder")
    kwargs = node.network_kwargs
    return resnet_sizes(kwargs.get("remove_layer_num", 2), kwargs.get("no_stride", False))


def fuse_all(network: Any, policy: Any) -> None:
    """Freeze encoders, or keep the instruction out of them, as the configuration says."""
    kwargs = policy.image_encoder.network_kwargs
    for encoder in network.encoders.values():
        fuse(
            encoder,
            pretrained=kwargs.get("pretrained", False),
            freeze=kwargs.get("freeze", False),
            language_fusion=kwargs.get("language_fusion", "film"),
        )


def temporal_sizes(policy: Any, embed_size: int) -> dict[str, Any]:
    """Arguments of the transformer over time.

    Raises:
        PolicyError: `transformer_input_size` is not the size of its tokens.
    """
    wanted = policy.get("transformer_input_size")
    if wanted not in (None, embed_size):
        raise PolicyError(
            f"transformer_input_size is {wanted}, its tokens are of {embed_size}; null takes theirs"
        )
    return {
        "layers": policy.transformer_num_layers,
        "heads": policy.transformer_num_heads,
        "head_dim": policy.transformer_head_output_size,
        "mlp_dim": policy.transformer_mlp_hidden_size,
        "dropout": policy.transformer_dropout,
    }


def encode_positions(network: Any, policy: Any) -> None:
    """Position codes with the configured factors."""
    kwargs, codes = policy.temporal_position_encoding.network_kwargs, network.transformer.positions
    scale = kwargs.get("factor_ratio")
    codes.copy_(
        sinusoidal_positions(codes.shape[0], codes.shape[1], kwargs.inv_freq_factor)
        * (1.0 if scale is None else scale)
    )


def _head(policy: Any) -> dict[str, Any]:
    """Arguments of the head."""
    node = policy.policy_head
    kind, kwargs = lookup(HEADS, "policy head", node.network), node.network_kwargs
    sizes = {"head_hidden": kwargs.hidden_size, "head_layers": kwargs.num_layers}
    if kind is not GMMHead:
        return {"head": "deterministic", **sizes}
    check_activation(kwargs.get("activation", "softplus"))
    return {
        "head": "gmm",
        **sizes,
        "modes": kwargs.num_modes,
        "min_std": kwargs.min_std,
        "low_eval_noise": kwargs.get("low_eval_noise", False),
    }


def _loss_coef(policy: Any) -> float:
    return float((policy.policy_head.get("loss_kwargs") or {}).get("loss_coef", 1.0))
