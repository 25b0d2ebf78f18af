"""Policies whose network is one of `lifelong.policies`, with the original's methods and configuration.

Shape legend: B batch, T time, M tokens per time step, E token, A action.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor, nn

from libero._adapters.lifelong.config import plain
from libero._adapters.lifelong.observations import policy_spec, to_native
from libero._adapters.lookup import lookup
from libero.lifelong.models.base_policy import BasePolicy
from libero.lifelong.models.modules.language_modules import ENCODERS, mlp
from libero.lifelong.models.modules.rgb_modules import configure_resnet, resnet_arguments
from libero.lifelong.models.policy_head import HEADS, GMMHead, check_activation, wrap_head
from lifelong.errors import PolicyError
from lifelong.nn.transformer import sinusoidal_positions
from lifelong.policies.history import HistoryPolicy
from lifelong.results.saved_config import upgrade_policy
from lifelong.settings import build


class NativePolicy(BasePolicy):
    """Policy with a `HistoryPolicy` as `network`, whose checkpoints and this policy's weights are interchangeable.

    `cfg.policy.native` holds further arguments of the network, as flat keys (see `upgrade_policy`). With `norm: batch`,
    `normalise_proprio: false` and `standardise_language: false` the network computes exactly what the original does.

    Raises:
        PolicyError: The networks do not support the configuration.
    """

    kind: type[HistoryPolicy]

    def __init__(self, cfg: Any, shape_meta: Mapping[str, Any]):
        super().__init__(cfg, shape_meta)
        policy = cfg.policy
        self.max_seq_len = int(policy.get("transformer_max_seq_len") or cfg.data.seq_len)
        self.spec = policy_spec(cfg, shape_meta, self.max_seq_len)
        arguments = {**self._arguments(policy), **_head_arguments(policy)}
        arguments |= plain(policy.get("native") or {})
        node = upgrade_policy({"_target_": f"{self.kind.__module__}.{self.kind.__name__}", **arguments})
        self.network: Any = build(OmegaConf.create(node), spec=self.spec)
        self._configure(policy)
        loss = policy.policy_head.get("loss_kwargs") or {}
        head = wrap_head(self.network.head, float(loss.get("loss_coef", 1.0)))
        object.__setattr__(self, "policy_head", head)  # not a submodule: its weights are the network's
        self.latent_queue: list[Tensor] = []

    @abstractmethod
    def _arguments(self, policy: Any) -> dict[str, Any]:
        """Return the network's arguments except those of the head, as flat keys."""

    def _configure(self, policy: Any) -> None:
        """Replace the parts of the network that the configuration changes."""
        if policy.image_encoder.network == "ResnetEncoder":
            for encoder in self.network.encoders.values():
                configure_resnet(encoder, **policy.image_encoder.network_kwargs)
        if hasattr(self.network, "transformer"):
            kwargs = policy.temporal_position_encoding.network_kwargs
            codes, scale = self.network.transformer.positions, kwargs.get("factor_ratio")
            new = sinusoidal_positions(codes.shape[0], codes.shape[1], kwargs.inv_freq_factor)
            codes.copy_(new * (1.0 if scale is None else scale))
        for name in ("language", "spatial_language"):
            if hasattr(self.network, name):
                token = getattr(self.network, name)
                token.linear = _language_encoder(policy, token.linear.out_features)
        for name, linear in self.network.proprio.linears.items() if policy.get("extra_num_layers") else ():
            layers, hidden = policy.extra_num_layers + 1, policy.extra_hidden_size
            self.network.proprio.linears[name] = mlp(linear.in_features, hidden, layers, linear.out_features)

    def spatial_encode(self, data: Mapping[str, Any]) -> Tensor:
        """Encode each frame by itself: (B, T, M, E), or (B, T, E) for the RNN."""
        return self.network.encode(to_native(data["obs"], data["task_emb"], self.spec))

    def temporal_encode(self, x: Tensor) -> Tensor:
        """Map (B, T, M, E) to (B, T, E), each step from its own frame and earlier ones."""
        return self.network.over_time(x)

    def forward(self, data: Mapping[str, Any]) -> Any:
        """Return the distribution of actions (B, T, A)."""
        return self.policy_head(self.temporal_encode(self.spatial_encode(data)))

    def get_action(self, data: Mapping[str, Any]) -> np.ndarray:
        """Return actions (B, A), drawn with torch's global generator."""
        self.eval()
        with torch.no_grad():
            dist = self.policy_head(self._latest_latent(self.preprocess_input(data, train_mode=False)))
            action = dist if isinstance(dist, Tensor) else dist.sample()
        return action.clamp(-1, 1).cpu().numpy()

    def reset(self) -> None:
        """See `BasePolicy`."""
        self.latent_queue = []

    def _latest_latent(self, data: Mapping[str, Any]) -> Tensor:
        """Append a frame to the history; return its latent (B, E)."""
        self.latent_queue = [*self.latent_queue, self.spatial_encode(data)][-self.max_seq_len :]
        return self.temporal_encode(torch.cat(self.latent_queue, dim=1))[:, -1]


def resnet_sizes(policy: Any) -> dict[str, Any]:
    """Return the arguments of a network with a ResNet for each camera."""
    node = policy.image_encoder
    if node.network != "ResnetEncoder":
        raise PolicyError(f"image_encoder is {node.network}; this policy needs a ResnetEncoder")
    return resnet_arguments(**node.network_kwargs)


def temporal_sizes(policy: Any, embed_size: int) -> dict[str, Any]:
    """Return the arguments of the transformer over time, whose tokens have the given size."""
    size = policy.get("transformer_input_size")
    if size not in (None, embed_size):
        raise PolicyError(
            f"transformer_input_size is {size}, but tokens have size {embed_size}; set it to null"
        )
    return {
        "layers": policy.transformer_num_layers,
        "heads": policy.transformer_num_heads,
        "head_dim": policy.transformer_head_output_size,
        "mlp_dim": policy.transformer_mlp_hidden_size,
        "dropout": policy.transformer_dropout,
    }


def _language_encoder(policy: Any, output_size: int) -> nn.Module:
    """Build the configured encoder from embeddings to `output_size` numbers."""
    node = policy.language_encoder
    kwargs = plain(node.network_kwargs)
    if node.network != "IdentityEncoder":
        kwargs["output_size"] = output_size
    elif kwargs["input_size"] != output_size:
        raise PolicyError(
            f"IdentityEncoder returns {kwargs['input_size']} numbers, but the policy takes {output_size}: make them "
            "equal, or use policy/language_encoder=mlp_encoder"
        )
    return lookup(ENCODERS, "language encoder", node.network)(**kwargs)


def _head_arguments(policy: Any) -> dict[str, Any]:
    """Return the network's arguments for the head, as flat keys."""
    node = policy.policy_head
    kind, kwargs = lookup(HEADS, "policy head", node.network), node.network_kwargs
    sizes = {"head_hidden": kwargs.hidden_size, "head_layers": kwargs.num_layers}
    if kind is not GMMHead:
        return {"head": "deterministic", **sizes}
    check_activation(kwargs.get("activation", "softplus"))
    noise = {"min_std": kwargs.min_std, "low_eval_noise": kwargs.get("low_eval_noise", False)}
    return {"head": "gmm", **sizes, "modes": kwargs.num_modes, **noise}
