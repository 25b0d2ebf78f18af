"""A run's directory: its configuration, records and checkpoints, with a lock while it is written.

config.yaml      resolved configuration
results.jsonl    records, append-only
checkpoints/     task_<k>.safetensors           after task k
                 progress.safetensors           while a task is learned; progress.previous.safetensors before it
                 best.safetensors               best weights so far of the task being learned
                 *.broken                       damaged, set aside
videos/          recorded rollouts
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import Timeout
from torch import Tensor

from libero_env.errors import InvalidInputError
from libero_env.storage import (
    PART_SUFFIX,
    atomic_write_text,
    leads_out,
    own_folder,
    read_yaml_file,
    system_lock,
)
from lifelong import checkpoints
from lifelong.errors import CheckpointError, ConfigError, RunLockedError
from lifelong.results.log import ResultLog
from lifelong.results.provenance import config_digest, result_relevant

BROKEN_SUFFIX = ".broken"

_RUN = (None, str)
_TASK = {"run": _RUN, "task": int, "policy": dict, "algorithm": dict}
_FIT = {"epoch": int, "loss": float, "penalty": float, "policy": dict, "optimizer": dict}
_PROGRESS = {**_TASK, "policy": (None, dict), "phase": int, "fit": (None, {**_FIT, "reference": dict}, _FIT)}
_BEST = {"run": _RUN, "task": int, "epoch": int, "policy": dict, "own": [Tensor]}


class CheckpointFolder:
    """The folder `checkpoints` of a run.

    Args:
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
        """Write the checkpoint after a task; what the one before it holds already, it refers to."""
        state = {"run": self._run(), "task": task, "policy": dict(policy), "algorithm": dict(algorithm)}
        earlier = [self.task_path(other) for other in self.tasks() if other < task]
        checkpoints.save(self.task_path(task), state, beside=earlier[-1] if earlier else None)
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
        state = self._load(path, _TASK, device)
        if path.stem.startswith("task_") and path.name != self.task_path(state["task"]).name:
            raise CheckpointError(
                f"{path} was written after task {state['task']}: checkpoints were exchanged or renamed. Put the "
                "right one there, or move this one away: the task is then learned again"
            )
        return state

    def load_progress(self, path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the state in `progress_path` or `previous_path`; errors are those of `load_task`."""
        return self._load(path, _PROGRESS, device)

    def load_best(self, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return the state in `best_path`; errors are those of `load_task`."""
        return self._load(self.best_path, _BEST, device)

    def require_own(self, path: Path) -> None:
        """Raise a CheckpointError where a checkpoint is a link that leads out of the run."""
        if leads_out(path, self.path.parent):
            raise CheckpointError(
                f"{path} is a link that leads out of {self.path.parent}; put the file itself there"
            )

    def set_aside(self, path: Path) -> Path:
        """Give a damaged checkpoint a name under which nothing reads it, and return that."""
        target = path.with_name(path.name + BROKEN_SUFFIX)
        os.replace(path, target)
        return target

    def _load(self, path: Path, form: Any, device: torch.device | str) -> dict[str, Any]:
        self.require_own(path)
        state = checkpoints.load(path, device)
        checkpoints.check(state, form, path)
        known = self._run()
        if None not in (known, state["run"]) and state["run"] != known:
            raise CheckpointError(
                f"{path} belongs to a run of another configuration than {self.path.with_name('config.yaml')}. "
                "Put the right one there, or move this one away: what it holds is then learned again"
            )
        return state


class RunDirectory:
    """Directory of everything a run did; created, or reopened with the same configuration."""

    def __init__(self, path: Path):
        self.path = path
        self.log = ResultLog(path / "results.jsonl")
        self.checkpoints = CheckpointFolder(path / "checkpoints", self._identity)
        self.videos = path / "videos"
        self._digest: str | None = None

    @contextmanager
    def opened(self, config: Mapping[str, Any], resume: bool) -> Iterator["RunDirectory"]:
        """Hold the directory's lock within the context, and write its configuration or compare with it.

        Args:
            config: Resolved configuration as plain data.
            resume: Whether to resume an existing run; otherwise it is moved aside.

        Raises:
            ConfigError: The existing run has another configuration, or a folder in it is a link.
            RunLockedError: Another process is writing there.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(self.path.with_name(f".{self.path.name}.lock")):
            if not resume and self.path.exists():
                os.rename(self.path, _free_name(self.path))
            self.path.mkdir(exist_ok=True)
            for folder in (self.videos, self.checkpoints.path):
                own_folder(self.path, folder.name, error=ConfigError)
            self._digest = None
            for part in self.path.rglob(f".*{PART_SUFFIX}"):  # left by a process that was killed
                part.unlink(missing_ok=True)
            self._check_config(dict(config))
            yield self

    def _check_config(self, config: dict[str, Any]) -> None:
        file = self.path / "config.yaml"
        if not file.exists():
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            atomic_write_text(file, text, fsync=True)
            return
        was, now = result_relevant(read_saved_config(file)), result_relevant(config)
        changed = [k for k in {**was, **now} if was.get(k) != now.get(k)]  # null: an older run may lack it
        if changed:
            pairs = [(k, was.get(k, "absent"), now.get(k, "absent")) for k in changed[:4]]
            listed = ", ".join(f"{k} {old!r} -> {new!r}" for k, old, new in pairs)
            more = f" and {len(changed) - 4} more" if len(changed) > 4 else ""
            raise ConfigError(
                f"{self.path} holds a run of another configuration ({listed}{more}). Give this run "
                "another name with run_id=NAME, or start again with resume=false (the old run is kept beside it)"
            )

    def _identity(self) -> str | None:
        """Return the digest of the saved configuration, by which checkpoints of this run are known."""
        if self._digest is None and (self.path / "config.yaml").exists():
            self._digest = config_digest(read_saved_config(self.path / "config.yaml"))
        return self._digest


def read_saved_config(path: str | Path) -> dict[str, Any]:
    """Return the content of a run's or pretraining's config.yaml as plain data.

    A run directory may be somebody else's, so nothing in it is executed or resolved: a text with `${...}` is a text.

    Args:
        path: File config.yaml.

    Raises:
        ConfigError: The file is missing, is not valid YAML, or holds no keys with values.
    """
    try:
        config = read_yaml_file(path).data
    except InvalidInputError as error:
        raise ConfigError(f"{error}; expected the configuration that a run has saved") from error
    if not isinstance(config, dict) or not config or not all(isinstance(key, str) for key in config):
        raise ConfigError(f"{path} is no configuration of a run: expected keys with values, such as seed: 1")
    return config


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file lock within the context; the system releases it whenever the process ends."""
    if path.is_symlink():  # which would be emptied where it leads
        raise ConfigError(f"{path} is a link; remove it")
    try:
        lock = system_lock(path)
    except Timeout as error:
        raise RunLockedError(
            f"another process is writing to {path.parent / path.name[1:-5]}; wait for it, or give this "
            "run another name with run_id=NAME"
        ) from error
    except OSError as error:  # such as ENOLCK of a network file system
        raise ConfigError(
            f"runs_dir: {path.parent} is on a file system that cannot lock files "
            f"({error.strerror}); mount it with locks, or set runs_dir to another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()


def _free_name(path: Path) -> Path:
    number = 1
    while (candidate := path.with_name(f"{path.name}.old{number}")).exists():
        number += 1
    return candidate


def check_writable(directory: Path) -> None:
    """Check that a directory exists or can be made, and files in it.

    Raises:
        ConfigError: They cannot.
    """
    nearest = next(folder for folder in (directory, *directory.parents) if os.path.lexists(folder))
    if not nearest.is_dir():
        raise ConfigError(f"runs_dir: {nearest} is a file; expected a folder, in which {directory} is made")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ConfigError(f"runs_dir: nothing can be written into {nearest}, in which {directory} is made")
