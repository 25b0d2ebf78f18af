"""The values that travel between the parts of the learning side.

Shape legend: B batch, T time, V views, H W C image, A action, L language embedding, K tasks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class PolicySpec:
    """What a policy sees and does; enough to build one and to make fake data for it."""

    views: tuple[str, ...] = ("agentview_rgb", "eye_in_hand_rgb")
    image_size: tuple[int, int] = (128, 128)
    proprio: Mapping[str, int] = field(  # name -> dimension, in order
        default_factory=lambda: {"joint_states": 7, "gripper_states": 2}
    )
    action_dim: int = 7
    language_dim: int = 384
    seq_len: int = 10


@dataclass(frozen=True)
class Observation:
    """What the policy sees: a window of frames (or T = 1 when acting)."""

    images: Tensor  # (B, T, V, H, W, C) uint8, upright
    proprio: Mapping[str, Tensor]  # name -> (B, T, D) float32
    language: Tensor  # (B, L) float32


@dataclass(frozen=True)
class Batch:
    """Windows of demonstrations, as the loss takes them."""

    observation: Observation
    actions: Tensor  # (B, T, A) float32
    task_ids: Tensor  # (B,) int64, position in the task sequence
    window_ids: Tensor  # (B,) int64, index of the window in its task's dataset

    def __len__(self) -> int:
        return self.actions.shape[0]

    def to(self, device: torch.device | str) -> "Batch":
        """The same batch on another device."""
        move = lambda x: x.to(device, non_blocking=True)  # noqa: E731
        obs = self.observation
        moved = Observation(
            move(obs.images), {k: move(v) for k, v in obs.proprio.items()}, move(obs.language)
        )
        return Batch(moved, move(self.actions), move(self.task_ids), move(self.window_ids))

    def rows(self, rows: slice | Tensor) -> "Batch":
        """Some of the windows: of a slice as views, of indices as copies in their order."""
        obs = self.observation
        part = Observation(obs.images[rows], {k: v[rows] for k, v in obs.proprio.items()}, obs.language[rows])
        return Batch(part, self.actions[rows], self.task_ids[rows], self.window_ids[rows])

    def join(self, other: "Batch") -> "Batch":
        """This batch followed by another, on the batch axis."""
        a, b = self.observation, other.observation
        joined = Observation(
            torch.cat([a.images, b.images]),
            {k: torch.cat([a.proprio[k], b.proprio[k]]) for k in a.proprio},
            torch.cat([a.language, b.language]),
        )
        rest = {f.name: torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)[1:]}
        return replace(self, observation=joined, **rest)
