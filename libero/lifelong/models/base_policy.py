"""Base class of the original's policies, and their registry.

Shape legend: B batch, T time, C H W image, D dimension of a proprioceptive input, A action, L language embedding.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from torch import Tensor, nn

from libero._adapters.batches import DictBatch, map_tensors
from libero._adapters.config import plain
from libero._adapters.lookup import lookup
from libero.lifelong.models.modules.data_augmentation import AUGMENTATIONS, DataAugGroup

REGISTERED_POLICIES: dict[str, type["BasePolicy"]] = {}


def register_policy(policy_class: type["BasePolicy"]) -> None:
    """Register a policy under its class name. Subclasses of BasePolicy are registered when they are defined."""
    REGISTERED_POLICIES[policy_class.__name__] = policy_class


def get_policy_class(policy_name: str) -> type["BasePolicy"]:
    """Return the policy of a name, ignoring case; raise an UnknownNameError if there is none."""
    return lookup(REGISTERED_POLICIES, "policy", policy_name)


def get_policy_list() -> dict[str, type["BasePolicy"]]:
    """Return all policies by name."""
    return dict(REGISTERED_POLICIES)


class PolicyMeta(type):
    """Registers every class of this metaclass under its name, except the two base classes."""

    def __init__(cls, name: str, bases: tuple, namespace: dict[str, Any]):
        super().__init__(name, bases, namespace)
        if name not in ("BasePolicy", "NativePolicy"):
            register_policy(cast(Any, cls))


class BasePolicy(nn.Module, metaclass=PolicyMeta):
    """Policy trained on dictionaries of windows.

    A subclass sets `policy_head` and implements `forward` and `get_action`; it never changes a batch. Data in training:
    `obs` {view: (B, T, C, H, W) in [0, 1], proprioceptive input: (B, T, D)}, `actions` (B, T, A), `task_emb` (B, L);
    when acting without T.

    Args:
        cfg: Configuration with `policy`, `data`, `train` and `device`.
        shape_meta: Shapes from `get_dataset`.
    """

    policy_head: Any

    def __init__(self, cfg: Any, shape_meta: Mapping[str, Any]):
        super().__init__()
        self.cfg, self.device, self.shape_meta = cfg, cfg.device, shape_meta
        self.img_names = [key for key in shape_meta["all_shapes"] if "rgb" in key]
        self.use_augmentation = bool(cfg.train.use_augmentation)
        augmentations: list[nn.Module] = []
        for key in ("color_aug", "translation_aug") if self.use_augmentation else ():
            if node := cfg.policy.get(key):
                kind = lookup(AUGMENTATIONS, "augmentation", node["network"])
                augmentations.append(kind(**plain(node["network_kwargs"])))
        self.img_aug = DataAugGroup(augmentations)

    @abstractmethod
    def forward(self, data: Mapping[str, Any]) -> Any:
        """Return the distribution of actions (B, T, A) from `policy_head`."""
        raise NotImplementedError(f"{type(self).__name__} has no forward(data)")

    @abstractmethod
    def get_action(self, data: Mapping[str, Any]) -> np.ndarray:
        """Return the next actions (B, A) from observations without a time axis."""
        raise NotImplementedError(f"{type(self).__name__} has no get_action(data)")

    def reset(self) -> None:
        """Forget the history: the next observation begins an episode."""

    def preprocess_input(self, data: Mapping[str, Any], train_mode: bool = True) -> dict[str, Any]:
        """Augment the images in training; when acting, add a time axis of one step."""
        if train_mode:
            if not self.use_augmentation:
                return dict(data)
            obs = {**data["obs"], **self._get_aug_output_dict(self.img_aug(self._get_img_tuple(data)))}
            return {**data, "obs": obs}
        stepped = map_tensors(dict(data), lambda x: x.unsqueeze(1))
        return {**stepped, "task_emb": data["task_emb"]} if "task_emb" in data else stepped

    def compute_loss(self, data: Mapping[str, Any], reduction: str = "mean") -> Tensor:
        """Return the head's loss on a batch; the reduction is `mean`, `sum` or `none`."""
        data = self.preprocess_input(data, train_mode=True)
        return self.policy_head.loss_fn(self.forward(data), data["actions"], reduction)

    def loss(self, batch: DictBatch) -> Tensor:
        """Return the mean loss, for the algorithms of `lifelong`."""
        return self.compute_loss(batch.data)

    def _get_img_tuple(self, data: Mapping[str, Any]) -> tuple[Tensor, ...]:
        return tuple(data["obs"][name] for name in self.img_names)

    def _get_aug_output_dict(self, out: Sequence[Tensor]) -> dict[str, Tensor]:
        return dict(zip(self.img_names, out, strict=True))
