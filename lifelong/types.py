"""The values that are passed between the parts of the learning side.

Shape legend: B batch, T time, V views, H W C image, A action, D size of a reading, L language embedding.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field

if TYPE_CHECKING:  # judging needs no PyTorch
    import torch
    from torch import Tensor


def _user_path(text: str) -> str:
    if not text or "\0" in text or len(text) > 4000 or max(map(len, text.split("/"))) > 255:
        shown = text if len(text) <= 80 else f"{text[:77]}..."
        raise ValueError(f"{shown!r} is not a path")
    return os.path.expanduser(text)


# Ranges of settings. Their upper ends are beyond what any machine can do; what this one can do is checked apart.
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Natural = Annotated[int, Field(ge=0, le=1_000_000_000)]
Width = Annotated[int, Field(ge=1, le=1_000_000)]  # of a layer or an image
Depth = Annotated[int, Field(ge=0, le=1000)]  # number of layers
Layers = Annotated[int, Field(ge=1, le=1000)]  # the same, at least one
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
PathText = Annotated[str, AfterValidator(_user_path)]


@dataclass(frozen=True)
class CompletedWith:
    """Annotation of a component that is not built yet: names of the arguments with which it is called."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class PolicySpec:
    """Inputs and outputs of a policy; enough to build one and to make fake data for it.

    Attributes:
        views: Names of the images.
        image_size: (H, W), pixels.
        proprio: Names of the proprioceptive readings, with their sizes, in order.
        action_dim: Number of entries of an action, A.
        language_dim: Size of the embedding of an instruction, L.
        seq_len: Number of steps in a window of training data, T.
        measured: Whether policies normalise by statistics of the data, which they are given, in place of constants.
    """

    views: tuple[str, ...] = ("agentview_rgb", "eye_in_hand_rgb")
    image_size: tuple[int, int] = (128, 128)
    proprio: Mapping[str, int] = field(default_factory=lambda: {"joint_states": 7, "gripper_states": 2})
    action_dim: int = 7
    language_dim: int = 384
    seq_len: int = 10
    measured: bool = False


@dataclass(frozen=True)
class Unfinished:
    """What is still executed of a chunk while the next one is computed.

    Attributes:
        actions: (L, A) actions that are left, the next one first.
        delay: Number of these that are probably executed before the next chunk is there.
    """

    actions: Tensor
    delay: int


def to_device(x: Tensor, device: torch.device | str) -> Tensor:
    """Return a tensor on a device, copied asynchronously to a GPU only.

    An asynchronous copy to the host returns before its values are there, and whoever reads them at once gets others.
    """
    import torch

    return x.to(device=device, non_blocking=torch.device(device).type == "cuda")


@dataclass(frozen=True)
class Observation:
    """What a policy sees: a window of frames, or T = 1 when it acts.

    Attributes:
        images: (B, T, V, H, W, C) uint8, upright.
        proprio: Name to (B, T, D) float32.
        language: Embedding of the instruction, (B, L) float32.
    """

    images: Tensor
    proprio: Mapping[str, Tensor]
    language: Tensor

    def map(self, change: Callable[[Tensor], Tensor]) -> Observation:
        """Return the observation with every tensor changed."""
        proprio = {name: change(reading) for name, reading in self.proprio.items()}
        return Observation(change(self.images), proprio, change(self.language))

    def to(self, device: torch.device | str) -> Observation:
        """Return the observation on another device."""
        return self.map(partial(to_device, device=device))


_COLUMNS = ("actions", "task_ids", "window_ids")  # of every batch, beside its observation


@dataclass(frozen=True)
class Batch:
    """Windows of demonstrations, as the loss takes them.

    Attributes:
        observation: What the policy sees.
        actions: What it should do, (B, T, A) float32.
        task_ids: Position of each window's task in the task sequence, (B,) int64.
        window_ids: Index of each window in its task's dataset, (B,) int64.
        is_pad: Whether a step is past the end of its demonstration, whose last frame and action it repeats, (B, T)
            bool. None where that is not known; it then counts as False.
    """

    observation: Observation
    actions: Tensor
    task_ids: Tensor
    window_ids: Tensor
    is_pad: Tensor | None = None

    def __len__(self) -> int:
        return self.actions.shape[0]

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """Return the batch with every tensor changed."""
        changed = {name: change(getattr(self, name)) for name in _COLUMNS}
        is_pad = None if self.is_pad is None else change(self.is_pad)
        return replace(self, observation=self.observation.map(change), is_pad=is_pad, **changed)

    def to(self, device: torch.device | str) -> Batch:
        """Return the batch on another device."""
        return self.map(partial(to_device, device=device))

    def rows(self, rows: slice | Tensor) -> Batch:
        """Return some rows, each a window: those of a slice as views, of indices (N,) as copies in their order."""
        return self.map(lambda x: x[rows])

    def padding(self) -> Tensor:
        """Return `is_pad`, False where it is not known, (B, T) bool."""
        if self.is_pad is None:
            import torch

            return torch.zeros(self.actions.shape[:2], dtype=torch.bool, device=self.actions.device)
        return self.is_pad

    def join(self, *others: Batch) -> Batch:
        """Return this batch followed by others."""
        import torch

        batches = (self, *others)
        seen = [batch.observation for batch in batches]
        joined = Observation(
            torch.cat([one.images for one in seen]),
            {name: torch.cat([one.proprio[name] for one in seen]) for name in seen[0].proprio},
            torch.cat([one.language for one in seen]),
        )
        rest = {name: torch.cat([getattr(batch, name) for batch in batches]) for name in _COLUMNS}
        known = any(batch.is_pad is not None for batch in batches)
        is_pad = torch.cat([batch.padding() for batch in batches]) if known else None
        return replace(self, observation=joined, is_pad=is_pad, **rest)
