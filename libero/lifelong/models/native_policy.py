"""The original's three policies: networks of `lifelong.policies` with its methods and configuration.

Shape legend: B batch, T time, M tokens per time step, E token, A action, D sum of the dimensions of inputs.
"""

from abc import abstractmethod
from collections.abc import Mapping
from inspect import signature
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor, nn

from libero._adapters.batches import PROPRIO, policy_spec, proprio_input, to_native
from libero._adapters.config import plain
from libero._adapters.lookup import lookup
from libero.lifelong.models.base_policy import BasePolicy
from libero.lifelong.models.modules.language_modules import ENCODERS, mlp
from libero.lifelong.models.modules.rgb_modules import (
    PatchEncoder,
    ResnetEncoder,
    configure_resnet,
    resnet_arguments,
    square,
)
from libero.lifelong.models.modules.transformer_modules import SinusoidalPositionEncoding
from libero.lifelong.models.policy_head import HEADS, GMMHead, check_activation, wrap_head
from libero_env.errors import require_known
from lifelong.errors import PolicyError
from lifelong.nn.transformer import sinusoidal_positions
from lifelong.policies import BCRNN, BCTransformer, BCViLT
from lifelong.policies.history import HistoryPolicy
from lifelong.settings import build

State = tuple[Tensor, Tensor]  # of an LSTM


class NativePolicy(BasePolicy):
    """Policy with a `HistoryPolicy` as `network`, whose checkpoints and this policy's weights are interchangeable.

    `cfg.policy.native` holds further arguments of the network and its parts. With `encoder: {norm: batch}`,
    `normalise_proprio: false` and `standardise_language: false` the network computes exactly what the original does.

    Raises:
        PolicyError: The networks do not support the configuration.
    """

    kind: type[HistoryPolicy]
    image_encoder: type = ResnetEncoder

    def __init__(self, cfg: Any, shape_meta: Mapping[str, Any]):
        super().__init__(cfg, shape_meta)
        policy = cfg.policy
        self.max_seq_len = int(policy.get("transformer_max_seq_len") or cfg.data.seq_len)
        self.spec = policy_spec(cfg, shape_meta, self.max_seq_len)
        self._check_keys(policy)
        arguments = {**self._arguments(policy), "head": _head(policy)}
        node = {"_target_": f"{self.kind.__module__}.{self.kind.__name__}", **arguments}
        whole: Any = OmegaConf.merge(node, plain(policy.get("native") or {}))
        self.network: Any = build(whole, spec=self.spec)
        self._configure(policy)
        loss = policy.policy_head.get("loss_kwargs") or {}
        head = wrap_head(self.network.head, float(loss.get("loss_coef", 1.0)))
        head.action_squash = bool(policy.policy_head.network_kwargs.get("action_squash", True))
        object.__setattr__(self, "policy_head", head)  # not a submodule: its weights are the network's
        self.latent_queue: list[Tensor] = []

    def _check_keys(self, policy: Any) -> None:
        """Raise an UnknownNameError for a network, or a key of its arguments, that would have no effect."""
        parts: dict[str, Mapping[str, type]] = {
            "image_encoder": {self.image_encoder.__name__: self.image_encoder},
            "policy_head": HEADS,
            "temporal_position_encoding": {"SinusoidalPositionEncoding": SinusoidalPositionEncoding},
        }
        for part, kinds in parts.items():
            if node := policy.get(part):
                known = signature(lookup(kinds, part, node.network)).parameters
                for key in (*node.network_kwargs, *(node.get("loss_kwargs") or ())):
                    require_known(f"key of policy.{part}", key, known)

    @abstractmethod
    def _arguments(self, policy: Any) -> dict[str, Any]:
        """Return the network's arguments except the head."""

    def _configure(self, policy: Any) -> None:
        """Replace the parts of the network that the configuration changes."""
        if self.image_encoder is ResnetEncoder:
            for encoder in self.network.encoders.values():
                configure_resnet(encoder, **policy.image_encoder.network_kwargs)
        if hasattr(self.network, "transformer"):
            kwargs = policy.temporal_position_encoding.network_kwargs
            if kwargs.get("factor_ratio") is not None:
                raise PolicyError(
                    "temporal_position_encoding: factor_ratio is not learned here; set it to null"
                )
            codes = self.network.transformer.positions
            codes.copy_(sinusoidal_positions(codes.shape[0], codes.shape[1], kwargs.inv_freq_factor))
        for name in ("language", "spatial_language"):
            if hasattr(self.network, name):
                token = getattr(self.network, name)
                token.linear = _language_encoder(policy, token.linear.out_features)
        for name, linear in self.network.proprio.linears.items() if policy.get("extra_num_layers") else ():
            layers, hidden = policy.extra_num_layers + 1, policy.extra_hidden_size
            self.network.proprio.linears[name] = mlp(linear.in_features, hidden, linear.out_features, layers)

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
        self.latent_queue = []

    def _latest_latent(self, data: Mapping[str, Any]) -> Tensor:
        """Append a frame to the history; return its latent (B, E)."""
        self.latent_queue = [*self.latent_queue, self.spatial_encode(data)][-self.max_seq_len :]
        return self.temporal_encode(torch.cat(self.latent_queue, dim=1))[:, -1]


class BCRNNPolicy(NativePolicy):
    """One vector of language, proprioception and cameras at each step, and an LSTM over time.

    When acting its state is carried, and reset every `data.seq_len` steps, as windows in training begin without one.
    """

    kind = BCRNN
    _state: State | None = None
    _age = 0  # steps since the state was empty

    def _arguments(self, policy: Any) -> dict[str, Any]:
        if policy.get("rnn_bidirectional"):
            raise PolicyError("rnn_bidirectional: a policy that acts cannot look ahead; set it to false")
        if policy.get("extra_num_layers"):
            raise PolicyError("extra_num_layers: this policy does not encode proprioception; set it to 0")
        return {
            "image_embed": policy.image_embed_size,
            "text_embed": policy.text_embed_size,
            "encoder": _resnet(policy),
            "temporal": _part(
                "TemporalLSTM",
                hidden=policy.rnn_hidden_size,
                layers=policy.rnn_num_layers,
                dropout=policy.rnn_dropout if policy.rnn_num_layers > 1 else 0.0,
            ),
        }

    def forward(self, data: Mapping[str, Any], train_mode: bool = True) -> Any:
        """Return the distribution of actions (B, T, A), from an empty state in training, else from that of the last."""
        latent, state = self.network.rnn(self.spatial_encode(data), None if train_mode else self._state)
        self._state = self._state if train_mode else state
        return self.policy_head(latent)

    def reset(self) -> None:
        super().reset()
        self._state, self._age = None, 0

    def _latest_latent(self, data: Mapping[str, Any]) -> Tensor:
        if self._age == self.max_seq_len:
            self.reset()
        latent, self._state = self.network.rnn(self.spatial_encode(data), self._state)
        self._age += 1
        return latent[:, -1]


class BCTransformerPolicy(NativePolicy):
    """Tokens of language, proprioception and cameras at each step, and a transformer over time."""

    kind = BCTransformer

    def _arguments(self, policy: Any) -> dict[str, Any]:
        size = policy.embed_size
        return {"embed_dim": size, "encoder": _resnet(policy), "temporal": _temporal(policy, size)}


class BCViLTPolicy(NativePolicy):
    """A transformer over the patches of a frame, and one over time."""

    kind, image_encoder = BCViLT, PatchEncoder

    def _arguments(self, policy: Any) -> dict[str, Any]:
        size, patch = policy.embed_size, policy.image_encoder.network_kwargs.patch_size
        token = policy.spatial_down_sample_embed_size if policy.spatial_down_sample else size
        return {
            "patch_embed": size,
            "embed_dim": token,
            "encoder": _part("PatchEncoder", patch=square(patch)),
            "spatial": _transformer("SpatialTransformer", policy, "spatial_transformer"),
            "temporal": _temporal(policy, token),
        }


def _proprio_sizes(**used: bool) -> dict[str, int]:
    """Return the inputs that are used, of joints (7), gripper (2) and hand (3), and their sizes."""
    sizes = dict(PROPRIO[key] for key, is_used in used.items() if is_used)
    if not sizes:
        raise PolicyError("no proprioceptive input is used: set use_joint, use_gripper or use_ee")
    return sizes


class ExtraModalities(nn.Module):
    """All inputs as one vector; the last two arguments have no effect, as in the original."""

    def __init__(
        self,
        use_joint: bool = False,
        use_gripper: bool = False,
        use_ee: bool = False,
        extra_hidden_size: int = 64,
        extra_embedding_size: int = 32,
    ):
        super().__init__()
        self.sizes = _proprio_sizes(use_joint=use_joint, use_gripper=use_gripper, use_ee=use_ee)
        self.extra_low_level_feature_dim = sum(self.sizes.values())

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Join inputs (B, T, ...) to (B, T, D)."""
        return torch.cat([proprio_input(obs_dict, name) for name in self.sizes], dim=-1)

    def output_shape(self, input_shape: object = None, shape_meta: object = None) -> tuple[int, ...]:
        """Return the shape of one time step."""
        return (self.extra_low_level_feature_dim,)


class ExtraModalityTokens(nn.Module):
    """One token for each input, through an MLP of `extra_num_layers` hidden layers."""

    def __init__(
        self,
        use_joint: bool = False,
        use_gripper: bool = False,
        use_ee: bool = False,
        extra_num_layers: int = 0,
        extra_hidden_size: int = 64,
        extra_embedding_size: int = 32,
    ):
        super().__init__()
        sizes = _proprio_sizes(use_joint=use_joint, use_gripper=use_gripper, use_ee=use_ee)
        layers = extra_hidden_size, extra_embedding_size, extra_num_layers + 1
        self.encoders = nn.ModuleDict({name: mlp(size, *layers) for name, size in sizes.items()})
        self.num_extra = len(sizes)

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Encode inputs (B, T, ...) as (B, T, M, E)."""
        tokens = [encoder(proprio_input(obs_dict, name)) for name, encoder in self.encoders.items()]
        return torch.stack(tokens, dim=-2)


def _part(name: str, **arguments: Any) -> dict[str, Any]:
    """Return the configuration of a part of a network, which the network completes."""
    return {"_target_": f"lifelong.nn.{name}", "_partial_": True, **arguments}


def _resnet(policy: Any) -> dict[str, Any]:
    return _part("ResNetFiLMEncoder", **resnet_arguments(**policy.image_encoder.network_kwargs))


def _temporal(policy: Any, embed_size: int) -> dict[str, Any]:
    size = policy.get("transformer_input_size")
    if size not in (None, embed_size):
        raise PolicyError(
            f"transformer_input_size is {size}, but tokens have size {embed_size}; set it to null"
        )
    return _transformer("TemporalTransformer", policy, "transformer")


def _transformer(name: str, policy: Any, prefix: str) -> dict[str, Any]:
    return _part(
        name,
        layers=policy[f"{prefix}_num_layers"],
        heads=policy[f"{prefix}_num_heads"],
        head_dim=policy[f"{prefix}_head_output_size"],
        mlp_dim=policy[f"{prefix}_mlp_hidden_size"],
        dropout=policy[f"{prefix}_dropout"],
    )


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


def _head(policy: Any) -> dict[str, Any]:
    node = policy.policy_head
    kind, kwargs = lookup(HEADS, "policy head", node.network), node.network_kwargs
    sizes = {"hidden": kwargs.hidden_size, "layers": kwargs.num_layers}
    if kind is not GMMHead:
        return _part("DeterministicHead", **sizes)
    check_activation(kwargs.get("activation", "softplus"))
    noise = {"min_std": kwargs.min_std, "low_eval_noise": kwargs.get("low_eval_noise", False)}
    return _part("GMMHead", **sizes, modes=kwargs.num_modes, **noise)
