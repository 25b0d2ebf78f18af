"""The checkpoints of a run: which there are, whether they belong to it, and what becomes of a damaged one.

task_<k>.safetensors           after task k
progress.safetensors           while a task is learned; progress.previous.safetensors is the one before it
best.safetensors               best weights so far of the task being learned
*.broken                       damaged, set aside
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.storage import PART_SUFFIX
from lifelong import checkpoints
from lifelong.errors import CheckpointError

BROKEN_SUFFIX = ".broken"

_RUN = (None, str)
_TASK = {"run": _RUN, "task": int, "policy": dict, "algorithm": dict}
_FIT = {"epoch": int, "loss": float, "penalty": float, "policy": dict, "optimizer": dict}
_PROGRESS = {**_TASK, "policy": (None, dict), "phase": int, "fit": (None, _FIT)}
_BEST = {"run": _RUN, "task": int, "epoch": int, "policy": dict, "own": [Tensor]}


class CheckpointFolder:
    """The folder `checkpoints` of a run.

    Args:
        path: The folder.
        run: Function that returns the digest by which the run's checkpoints are known; None where it has none.
    """

    def __init__(self, path: Path, run: Callable[[], str | None] = lambda: None):
        self.path, self._run = path, run
        self.progress_path = path / "progress.safetensors"
        self.previous_path = path / "progress.previous.safetensors"
        self.best_path = path / "best.safetensors"

    def task_path(self, task: int) -> Path:
        """Return the path of the checkpoint written after a task."""
        return self.path / f"task_{task}.safetensors"

    def tasks(self) -> list[int]:
        """Return the positions of the tasks that have a checkpoint, in ascending order."""
        names = (file.stem.removeprefix("task_") for file in self.path.glob("task_*.safetensors"))
        return sorted(int(name) for name in names if name.isascii() and name.isdecimal())

    def save_task(self, task: int, policy: Mapping[str, Tensor], algorithm: Mapping[str, Any]) -> None:
        """Write the checkpoint after a task."""
        state = {"run": self._run(), "task": task, "policy": dict(policy), "algorithm": dict(algorithm)}
        checkpoints.save(self.task_path(task), state)
        self.previous_path.unlink(missing_ok=True)  # the task is safe without it

    def save_progress(self, state: Mapping[str, Any]) -> None:
        """Write the progress on a task, and keep the one before it.

        Args:
            state: The keys `task`, `phase`, `fit`, `policy` and `algorithm`, see `lifelong.sequence`.
        """
        checkpoints.save(self.progress_path, {"run": self._run(), **state}, previous=self.previous_path)

    def save_best(self, task: int, epoch: int, policy: Mapping[str, Tensor], own: list[Tensor]) -> None:
        """Write the best weights so far of a task, with the algorithm's own parameters."""
        state = {"run": self._run(), "task": task, "epoch": epoch, "policy": dict(policy), "own": own}
        checkpoints.save(self.best_path, state)

    def load_task(self, path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the state after a task.

        Args:
            path: File that `save_task` wrote, of any name but that of another task.
            device: Device of the tensors.

        Raises:
            DamagedCheckpointError: The file is damaged, or no checkpoint.
            CheckpointError: The file is missing, or belongs to another task or run.
        """
        state = self._checked(checkpoints.load(path, device), _TASK, path)
        if path.stem.startswith("task_") and path.name != self.task_path(state["task"]).name:
            raise CheckpointError(
                f"{path} was written after task {state['task']}: checkpoints were exchanged or renamed. Put the "
                "right one there, or move this one away: the task is then learned again"
            )
        return state

    def load_progress(self, path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the state in `progress_path` or `previous_path`; errors are those of `load_task`."""
        return self._checked(checkpoints.load(path, device), _PROGRESS, path)

    def load_best(self, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the state in `best_path`; errors are those of `load_task`."""
        state = checkpoints.load(self.best_path, device)
        return self._checked(state, _BEST, self.best_path)

    def set_aside(self, path: Path) -> Path:
        """Give a damaged checkpoint a name under which nothing reads it, and return that."""
        target = path.with_name(path.name + BROKEN_SUFFIX)
        os.replace(path, target)
        return target

    def clear_unfinished(self) -> None:
        """Remove what processes left that were killed while they wrote a checkpoint."""
        for file in self.path.glob(f".*{PART_SUFFIX}"):
            file.unlink(missing_ok=True)

    def _checked(self, state: dict[str, Any], form: Any, path: Path) -> dict[str, Any]:
        checkpoints.check(state, form, path)
        known = self._run()
        if None not in (known, state["run"]) and state["run"] != known:
            raise CheckpointError(
                f"{path} belongs to a run of another configuration than {self.path.with_name('config.yaml')}. "
                "Put the right one there, or move this one away: what it holds is then learned again"
            )
        return state
