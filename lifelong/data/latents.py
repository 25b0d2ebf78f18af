"""Memory of past tasks that keeps latents of their windows, in eight bits.

Shape legend: N windows, B batch, T time, A action.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lifelong.data.memory import TaskMemory, even_shares
from lifelong.data.windows import divided
from lifelong.errors import DataError

_TENSORS = ("codes", "low", "step", "actions")
# see `lifelong.checkpoints.check`
LATENTS_FORM = {"budget": int, "tasks": {int: dict.fromkeys(_TENSORS, Tensor)}}
_LEVELS = 255  # steps between the least and the greatest value of a feature


@dataclass(frozen=True, eq=False)
class LatentWindows:
    """Latents of a task's windows, each number rounded to one of 256 values of its feature, and their actions.

    Attributes:
        codes: (N, T, ...) uint8.
        low: Least value of each feature, (...) float32.
        step: Distance of neighbouring values of each feature, (...) float32; zero where it is constant.
        actions: (N, T, A) float32.
    """

    codes: Tensor
    low: Tensor
    step: Tensor
    actions: Tensor

    @classmethod
    def of(cls, latents: Tensor, actions: Tensor) -> "LatentWindows":
        """Return latents (N, T, ...) rounded, with actions (N, T, A); no number moves by more than half a step."""
        latents = latents.float()
        low, high = latents.flatten(0, 1).amin(0), latents.flatten(0, 1).amax(0)
        step = (high - low) / _LEVELS
        codes = (latents - low) / step.where(step > 0, torch.ones_like(step))
        return cls(codes.round_().clamp_(0, _LEVELS).to(torch.uint8), low, step, actions.float())

    def __len__(self) -> int:
        """Return the number of windows, N."""
        return len(self.codes)

    def values(self, rows: Tensor) -> Tensor:
        """Return the latents of some windows, (B,) int64 -> (B, T, ...) float32."""
        return self.codes[rows].float() * self.step + self.low

    def first(self, windows: int) -> "LatentWindows":
        """Return the first windows."""
        return LatentWindows(
            self.codes[:windows].clone(), self.low, self.step, self.actions[:windows].clone()
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return all tensors by name."""
        return {name: getattr(self, name) for name in _TENSORS}

    def check(self) -> None:
        """Check that the tensors, which come from a file, fit together.

        Raises:
            DataError: They do not.
        """
        if not (
            self.codes.dtype == torch.uint8
            and self.codes.dim() > 2
            and self.codes.shape[2:] == self.low.shape == self.step.shape
            and self.actions.dim() == 3
            and self.actions.shape[:2] == self.codes.shape[:2]
            and all(x.dtype == torch.float32 for x in (self.low, self.step, self.actions))
        ):
            raise DataError("latents of the memory contradict their ranges or their actions")


class LatentMemory(TaskMemory[LatentWindows]):
    """Latents of windows of each past task, within one budget of windows that is divided evenly.

    Args:
        budget: Largest number of windows over all tasks.
    """

    def add(self, task: int, latents: Tensor, actions: Tensor) -> None:
        """Add a task's windows; when another one is added, the first ones stay.

        Args:
            latents: Latents in random order, (N, T, ...).
            actions: Actions of the same windows, (N, T, A).

        Raises:
            DataError: The task is in the memory already.
        """
        self._require_new(task)
        self.tasks[task] = LatentWindows.of(latents.cpu(), actions.cpu())
        for known, share in even_shares(self.shares, self.budget).items():
            if share < len(self.tasks[known]):
                self.tasks[known] = self.tasks[known].first(share)

    def sample(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return latents (n, T, ...) and actions (n, T, A) of windows, on the CPU; see `ReplayMemory.sample`."""
        parts = list(divided(list(self.tasks.values()), self._draw(n, generator)))
        latents, actions = zip(
            *((windows.values(rows), windows.actions[rows]) for windows, rows in parts), strict=True
        )
        return torch.cat(latents), torch.cat(actions)

    def load_state_dict(self, state: Mapping[str, Any], datasets: object = None) -> None:
        """Restore what `state_dict` returned.

        Raises:
            DataError: The state contradicts itself; the memory is unchanged.
        """
        tasks = {}
        for task, kept in state["tasks"].items():
            tasks[task] = LatentWindows(**{name: kept[name].cpu() for name in _TENSORS})
            tasks[task].check()
        self.budget, self.tasks = int(state["budget"]), tasks
