"""Experience replay."""

from collections.abc import Mapping
from typing import Any

import torch

from lifelong.algorithms.base import Algorithm, WindowDataset, as_libero
from lifelong.data.memory import FirstWindows, ReplayMemory
from lifelong.policies.base import Policy
from lifelong.types import Batch


class ER(Algorithm):
    """Join to every batch as many windows of earlier tasks (Chaudhry et al. 2019; LIBERO, section 4).

    The memory is a uniform sample of each task's windows, within one budget over all tasks. With `compat="libero"` it
    is as in LIBERO's code, where the paper says trajectories: the first `per_task` windows of each task's file. With
    that go the results of Liu et al., table 8 (FWT / NBT / AUC of ResNet-T: LONG .48 / .32 / .32, SPATIAL
    .65 / .27 / .56, OBJECT .67 / .43 / .44, GOAL .64 / .34 / .49).
    """

    def __init__(
        self, *, budget: int = 10_000, ratio: float = 1.0, per_task: int = 1000, compat: str | None = None
    ):
        """Make the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks; not used with `compat="libero"`.
            ratio: Windows replayed for each window of the present task; 1 doubles the batch.
            per_task: Windows kept of each task with `compat="libero"`; not used without.
            compat: None, or `libero` for the choices of LIBERO's code.

        Raises:
            ConfigError: Another `compat`.
        """
        self.ratio = ratio
        self.memory = FirstWindows(per_task) if as_libero(compat) else ReplayMemory(budget)

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch followed by `ratio` times as many windows of earlier tasks."""
        if not len(self.memory):
            return batch
        return batch.join(self.memory.sample(max(1, round(self.ratio * len(batch))), generator))

    def end_task(
        self, task_index: int, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> None:
        """Take the task's windows in; the earlier tasks' shares shrink."""
        self.memory.add(dataset, generator)

    def state_dict(self) -> dict[str, Any]:
        """Which windows are kept; their frames are read again from the demonstrations."""
        return {"memory": self.memory.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], datasets)
