"""A run's directory: its configuration, records and checkpoints, with a lock while it is written.

config.yaml      resolved configuration
results.jsonl    records, append-only
checkpoints/     see `lifelong.results.checkpoint_folder`
videos/          recorded rollouts
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from libero_env.errors import InvalidInputError
from libero_env.storage import PART_SUFFIX, atomic_write_text, read_yaml_file
from lifelong.errors import ConfigError, RunLockedError
from lifelong.results.checkpoint_folder import CheckpointFolder
from lifelong.results.log import ResultLog

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
    "eval.transfer",  # how records are read, not what they hold
    "eval.shift",  # evaluations besides all others
)


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
            ConfigError: The existing run has another configuration.
            RunLockedError: Another process is writing there.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(self.path.with_name(f".{self.path.name}.lock")):
            if not resume and self.path.exists():
                os.rename(self.path, _free_name(self.path))
            self.path.mkdir(exist_ok=True)
            self._digest = None
            for part in self.path.rglob(f".*{PART_SUFFIX}"):  # left by a process that was killed
                part.unlink(missing_ok=True)
            self.checkpoints.clear_unfinished()
            self._check_config(dict(config))
            yield self

    def _check_config(self, config: dict[str, Any]) -> None:
        file = self.path / "config.yaml"
        if not file.exists():
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            atomic_write_text(file, text, fsync=True)
            return
        was, now = result_relevant(read_saved_config(file)), result_relevant(config)
        changed = [k for k in {**was, **now} if was.get(k, "absent") != now.get(k, "absent")]
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


def result_relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a configuration that affect results, by dotted key."""
    volatile = tuple(f"{key}." for key in VOLATILE)
    return {k: v for k, v in _flat(dict(config)).items() if not f"{k}.".startswith(volatile)}


def config_digest(config: Mapping[str, Any]) -> str:
    """Return 16 hex digits that change with whatever affects the results of a configuration."""
    text = json.dumps(result_relevant(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file lock within the context; the system releases it whenever the process ends."""
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunLockedError(
                f"another process is writing to {path.parent / path.name[1:-5]}; wait for it, or give this "
                "run another name with run_id=NAME"
            ) from error
        except OSError as error:  # such as ENOLCK of a network file system
            raise ConfigError(
                f"runs_dir: {path.parent} is on a file system that cannot lock files ({error.strerror}); mount it "
                "with locks, or set runs_dir to another folder"
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
