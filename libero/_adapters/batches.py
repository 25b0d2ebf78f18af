"""The original's batches and observations as those of `lifelong`.

The original: nested dictionaries of tensors, images (B, T, C, H, W) in [0, 1], bottom row first as OpenGL renders.
`lifelong`: `Observation`, images (B, T, V, H, W, C) uint8, top row first.

Shape legend: B batch, T time, V views, C H W image, D dimension of a proprioceptive input, L language embedding.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from lifelong.errors import PolicyError
from lifelong.types import Observation, PolicySpec, to_device

# key of `data` -> proprioceptive input and its dimension
PROPRIO = {"use_joint": ("joint_states", 7), "use_gripper": ("gripper_states", 2), "use_ee": ("ee_pos", 3)}


@dataclass(frozen=True)
class DictBatch:
    """Nested dictionary of tensors with a common batch axis, and the indices of windows of a dataset."""

    data: Any
    window_ids: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))

    def __len__(self) -> int:
        if isinstance(self.data, dict):
            return max((len(DictBatch(part)) for part in self.data.values()), default=0)
        return len(self.data) if isinstance(self.data, Tensor) and self.data.dim() else 0

    def to(self, device: torch.device | str) -> "DictBatch":
        """Return the batch on another device."""
        return DictBatch(
            map_tensors(self.data, lambda x: to_device(x, device)), to_device(self.window_ids, device)
        )

    def join(self, other: "DictBatch") -> "DictBatch":
        """Return this batch followed by another, with the entries that both have."""
        ids = torch.cat([self.window_ids, other.window_ids])
        return DictBatch(join_tensors(self.data, other.data), ids)


class DictWindows:
    """Any dataset of nested dictionaries of tensors as `lifelong.data.windows.TaskWindows`; workers read for `load`."""

    def __init__(self, dataset: Any, task_id: int, num_workers: int = 0):
        self.dataset, self.task_id, self.num_workers = dataset, task_id, num_workers

    def __len__(self) -> int:
        return len(self.dataset)

    def batch(self, indices: Tensor) -> DictBatch:
        """Return the windows of the given indices, (B,) int64."""
        return DictBatch(default_collate([self.dataset[int(i)] for i in indices]), indices)

    def load(self, batches: Iterable[Tensor]) -> Iterator[DictBatch]:
        """Return the windows of each tensor of indices, read ahead by worker processes."""
        sampler = [indices.tolist() for indices in batches]
        return map(DictBatch, DataLoader(self.dataset, batch_sampler=sampler, num_workers=self.num_workers))


def map_tensors(node: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Return a nested dictionary with a function applied to all its tensors; the argument is not changed."""
    if isinstance(node, Tensor):
        return change(node)
    return {k: map_tensors(v, change) for k, v in node.items()} if isinstance(node, dict) else node


def join_tensors(a: Any, b: Any) -> Any:
    """Return nested dictionaries of tensors joined along the first dimension, with the entries that both have."""
    if isinstance(a, Tensor):
        return torch.cat([a, b.to(a.device)])
    return {k: join_tensors(v, b[k]) for k, v in a.items() if k in b} if isinstance(a, dict) else a


def policy_spec(cfg: Any, shape_meta: Mapping[str, Any], history: int) -> PolicySpec:
    """Return the spec of a policy that keeps `history` frames when it acts; `data.use_*` select its inputs.

    Raises:
        PolicyError: There are no images, or they differ in size.
    """
    shapes = shape_meta["all_shapes"]
    views = [key for key in shapes if "rgb" in key and (cfg.data.use_eye_in_hand or "eye_in_hand" not in key)]
    sizes = {tuple(shapes[view])[1:] for view in views}
    if len(sizes) != 1:
        raise PolicyError(
            f"a policy needs images of one size; {views or 'no views'} have sizes {sorted(sizes)}"
        )
    return PolicySpec(
        views=tuple(views),
        image_size=sizes.pop(),
        proprio={name: size for key, (name, size) in PROPRIO.items() if cfg.data[key]},
        action_dim=shape_meta["ac_dim"],
        language_dim=cfg.policy.language_encoder.network_kwargs.input_size,
        seq_len=max(history, cfg.data.seq_len),
    )


def to_native(obs: Mapping[str, Tensor], task_emb: Tensor, spec: PolicySpec) -> Observation:
    """Convert the original's dictionary to an `Observation`, with images rounded to 256 levels.

    Args:
        obs: View -> (B, T, C, H, W), proprioceptive input -> (B, T, D).
        task_emb: Embedding of the instruction, (B, L).
        spec: Views and proprioceptive inputs to take.
    """
    images = torch.stack([uint8_image(obs[view]).flip(-3) for view in spec.views], dim=2).contiguous()
    proprio = {name: proprio_input(obs, name) for name in spec.proprio}
    return Observation(images, proprio, task_emb.float())


def proprio_input(obs: Mapping[str, Tensor], name: str) -> Tensor:
    """Return one proprioceptive input; the hand's position is also the beginning of `ee_states`."""
    if name == "ee_pos" and name not in obs and "ee_states" in obs:
        return obs["ee_states"][..., :3].float()
    if name not in obs:
        raise PolicyError(f"the observation lacks {name}; it has {', '.join(obs)}. See data.obs.modality")
    return obs[name].float()


def uint8_image(images: Tensor) -> Tensor:
    """Convert (..., C, H, W) in [0, 1] to (..., H, W, C) uint8."""
    if images.dtype != torch.uint8:
        images = (images * 255).round().clamp(0, 255).to(torch.uint8)
    return images.movedim(-3, -1).contiguous()


def image_tensor(image: np.ndarray | Tensor) -> Tensor:
    """Convert (..., H, W, C) uint8 to (..., C, H, W) in [0, 1]."""
    return torch.as_tensor(np.ascontiguousarray(image)).movedim(-1, -3).contiguous().float() / 255
