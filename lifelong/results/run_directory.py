"""A run's directory: its configuration, records and checkpoints, with a lock while it is written.

config.yaml      resolved configuration
results.jsonl    records, append-only
checkpoints/     task_<k>.safetensors after each task; progress and best weights of the current task
videos/          recorded rollouts
"""

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from libero_env.storage import PART_SUFFIX, atomic_write_text
from lifelong import checkpoints
from lifelong.errors import ConfigError, LifelongError
from lifelong.results.log import ResultLog
from lifelong.results.saved_config import upgrade_config

# Keys that may differ between the start of a run and its resumption, because they change no result.
VOLATILE = (
    "device",
    "progress",
    "resume",
    "run_id",
    "runs_dir",
    "threads",
    "wandb",
    "data.memory",
    "data.backend",
)


class RunDirectory:
    """Directory of everything a run did; created, or reopened with the same configuration."""

    def __init__(self, path: Path):
        self.path = path
        self.log = ResultLog(path / "results.jsonl")
        self.videos = path / "videos"

    @contextmanager
    def opened(self, config: Mapping[str, Any], resume: bool) -> Iterator["RunDirectory"]:
        """Hold the directory's lock within the context, and write its configuration or compare with it.

        Args:
            config: Resolved configuration as plain data.
            resume: Whether to resume an existing run; otherwise it is moved aside.

        Raises:
            ConfigError: The existing run has another configuration.
            LifelongError: Another process is writing there.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(self.path.with_name(f".{self.path.name}.lock")):
            if not resume and self.path.exists():
                os.rename(self.path, _free_name(self.path))
            self.path.mkdir(exist_ok=True)
            for part in self.path.rglob(f"*{PART_SUFFIX}"):  # left by a process that was killed
                part.unlink()
            self._check_config(dict(config))
            yield self

    def _check_config(self, config: dict[str, Any]) -> None:
        file = self.path / "config.yaml"
        if not file.exists():
            atomic_write_text(file, yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
            return
        old = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
        was, now = result_relevant(upgrade_config(old)), result_relevant(config)
        changed = [k for k in {**was, **now} if was.get(k, "absent") != now.get(k, "absent")]
        if changed:
            pairs = [(k, was.get(k, "absent"), now.get(k, "absent")) for k in changed[:4]]
            listed = ", ".join(f"{k} {old!r} -> {new!r}" for k, old, new in pairs)
            more = f" and {len(changed) - 4} more" if len(changed) > 4 else ""
            raise ConfigError(
                f"{self.path} holds a run of another configuration ({listed}{more}). Give this run "
                "another name with run_id=NAME, or start again with resume=false (the old run is kept beside it)"
            )

    @property
    def started(self) -> bool:
        """Whether there is any checkpoint."""
        return any((self.path / "checkpoints").glob("*.safetensors"))

    def task_path(self, task: int) -> Path:
        """Return the path of the checkpoint written after a task."""
        return self.path / "checkpoints" / f"task_{task}.safetensors"

    @property
    def progress_path(self) -> Path:
        """Path of the checkpoint written while a task is learned."""
        return self.path / "checkpoints" / "progress.safetensors"

    @property
    def best_path(self) -> Path:
        """Path of the best weights so far of the task being learned."""
        return self.path / "checkpoints" / "best.safetensors"

    def progress(self, task: int, device: Any = "cpu") -> dict[str, Any] | None:
        """Read the saved progress on a task; None if there is none."""
        if not self.progress_path.exists():
            return None
        state = checkpoints.load(self.progress_path, device)
        return state if state["task"] == task else None


def result_relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a configuration that affect results, by dotted key."""
    volatile = tuple(f"{key}." for key in VOLATILE)
    return {k: v for k, v in _flat(dict(config)).items() if not f"{k}.".startswith(volatile)}


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file lock within the context; the system releases it whenever the process ends."""
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LifelongError(
                f"another process is writing to {path.parent / path.name[1:-5]}; wait for it, or give this "
                "run another name with run_id=NAME"
            ) from error
        yield


def _free_name(path: Path) -> Path:
    number = 1
    while (candidate := path.with_name(f"{path.name}.old{number}")).exists():
        number += 1
    return candidate


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix: value}
    parts = (_flat(v, f"{prefix}.{k}" if prefix else str(k)) for k, v in value.items())
    return {k: v for part in parts for k, v in part.items()}
