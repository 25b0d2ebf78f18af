"""The original's three policies: networks of `lifelong.policies` with its methods and configuration.

Shape legend: B batch, T time, M tokens per time step, E token, A action, D sum of the dimensions of inputs.
"""

from abc import abstractmethod
from collections.abc import Mapping
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
from libero.lifelong.models.modules.rgb_modules import configure_resnet, resnet_arguments, square
from libero.lifelong.models.policy_head import HEADS, GMMHead, check_activation, wrap_head
from lifelong.errors import PolicyError
from lifelong.nn.transformer import sinusoidal_positions
from lifelong.policies import BCRNN, BCTransformer, BCViLT
from lifelong.policies.history import HistoryPolicy
from lifelong.settings import build

State = tuple[Tensor, Tensor]  # of an LSTM
Keys = dict[
    str, str
]  # flat key -> key of a component of the network; other flat keys are those of the network


def _keys(same: str, **renamed: str) -> Keys:
    """Return keys that are the same for the component, separated by blanks, and those that have another name there."""
    return {**{key: key for key in same.split()}, **renamed}


_RESNET = _keys(
    "stage_blocks stem_kernel stem_stride stem_pool keypoints readout norm",
    image_width="width",
    keypoint_temperature="temperature",
)
_PATCHES = _keys("stem_kernel stem_stride patch norm", patch_width="width")
_SPATIAL = _keys("dropout", **{f"spatial_{key}": key for key in ("layers", "heads", "head_dim", "mlp_dim")})
_TRANSFORMER = _keys("layers heads head_dim mlp_dim dropout")
_LSTM = _keys("dropout", rnn_hidden="hidden", rnn_layers="layers")
_TRUNK = _keys("", head_hidden="hidden", head_layers="layers")
_GMM = _keys("modes min_std low_eval_noise", head_norm="norm", **_TRUNK)
_HEADS = {
    "deterministic": ("DeterministicHead", _keys("", head_norm="norm", **_TRUNK)),
    "gmm": ("GMMHead", _GMM),
    "flow": ("FlowHead", _keys("chunk execute", flow_steps="steps", **_TRUNK)),
}
_RESNET_FILM, _TEMPORAL = ("ResNetFiLMEncoder", _RESNET), ("TemporalTransformer", _TRANSFORMER)
_COMPONENTS: dict[type[HistoryPolicy], dict[str, tuple[str, Keys]]] = {
    BCTransformer: {"encoder": _RESNET_FILM, "temporal": _TEMPORAL},
    BCRNN: {"encoder": _RESNET_FILM, "temporal": ("TemporalLSTM", _LSTM)},
    BCViLT: {
        "encoder": ("PatchEncoder", _PATCHES),
        "spatial": ("SpatialTransformer", _SPATIAL),
        "temporal": _TEMPORAL,
    },
}


class NativePolicy(BasePolicy):
    """Policy with a `HistoryPolicy` as `network`, whose checkpoints and this policy's weights are interchangeable.

    `cfg.policy.native` holds further arguments of the network, as flat keys. With `norm: batch`,
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
        self.network: Any = build(OmegaConf.create(_node(self.kind, arguments)), spec=self.spec)
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
            "rnn_hidden": policy.rnn_hidden_size,
            "rnn_layers": policy.rnn_num_layers,
            "dropout": policy.rnn_dropout,
            **resnet_sizes(policy),
        }

    def forward(
        self, data: Mapping[str, Any], init_state: State | None = None, return_state: bool = False
    ) -> Any:
        """Return the distribution of actions (B, T, A) from a state, by default empty; and the state after it."""
        latent, state = self.network.rnn(self.spatial_encode(data), init_state)
        dist = self.policy_head(latent)
        return (dist, state) if return_state else dist

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
        return {"embed_dim": size, **resnet_sizes(policy), **temporal_sizes(policy, size)}


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


class _ProprioEncoder(nn.Module):
    """Base of encoders of joints (7), gripper (2) and hand (3), through MLPs of `extra_num_layers` hidden layers."""

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
        used = {"use_joint": use_joint, "use_gripper": use_gripper, "use_ee": use_ee}
        self.sizes = dict(PROPRIO[key] for key, is_used in used.items() if is_used)
        if not self.sizes:
            raise PolicyError("no proprioceptive input is used: set use_joint, use_gripper or use_ee")
        self.extra_embedding_size = extra_embedding_size
        self._build(extra_num_layers, extra_hidden_size, extra_embedding_size)

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        raise NotImplementedError

    def _inputs(self, obs_dict: Mapping[str, Tensor]) -> list[Tensor]:
        return [proprio_input(obs_dict, name) for name in self.sizes]


class ExtraModalities(_ProprioEncoder):
    """All inputs as one vector; without hidden layers they are not encoded."""

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        self.extra_low_level_feature_dim = self.output_size = sum(self.sizes.values())
        self.extra_encoder: nn.Module = nn.Identity()
        if num_layers:
            self.extra_encoder = mlp(self.output_size, hidden, num_layers + 1, embedding)
            self.output_size = embedding

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Encode inputs (B, T, ...) as (B, T, D), or as (B, T, E) with hidden layers."""
        return self.extra_encoder(torch.cat(self._inputs(obs_dict), dim=-1))

    def output_shape(self, input_shape: object = None, shape_meta: object = None) -> tuple[int, ...]:
        """Return the shape of one time step."""
        return (self.output_size,)


class ExtraModalityTokens(_ProprioEncoder):
    """One token for each input."""

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        encoders = {name: mlp(size, hidden, num_layers + 1, embedding) for name, size in self.sizes.items()}
        self.num_extra, self.encoders = len(encoders), nn.ModuleDict(encoders)

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Encode inputs (B, T, ...) as (B, T, M, E)."""
        inputs = zip(self.encoders.values(), self._inputs(obs_dict), strict=True)
        return torch.stack([encoder(x) for encoder, x in inputs], dim=-2)


def _node(kind: type[HistoryPolicy], arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a network from flat keys, such as `image_width` for the width of its encoder."""
    components = {**_COMPONENTS[kind], "head": _HEADS[arguments.pop("head")]}
    flat = {key for _, keys in (*components.values(), *_HEADS.values()) for key in keys}
    node = {key: value for key, value in arguments.items() if key not in flat}
    for name, (target, keys) in components.items():
        values = {new: arguments[old] for old, new in keys.items() if old in arguments}
        node[name] = {"_target_": f"lifelong.nn.{target}", "_partial_": True, **values}
    return {"_target_": f"{kind.__module__}.{kind.__name__}", **node}


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
