"""The tasks of this package as files of the original: `<suite>/<task>.bddl`, `<suite>/<task>.pruned_init`."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from libero._adapters.envs.models import assets_folder
from libero_env.init_states.pickles import write_states
from libero_env.init_states.store import shipped_path
from libero_env.paths import cache_dir, demos_dir
from libero_env.storage import atomic_path
from libero_env.tasks import Task, get_suite, suite_names

_COMPLETE = ".complete"  # written last: after an interruption all files are written again


def generated_paths() -> dict[str, str]:
    """Return the default folders of task files, initial states, demonstrations and assets; nothing is written."""
    root = cache_dir() / "facade"
    return {
        "bddl_files": str(root / f"bddl_files-{_tasks_digest()}"),
        "init_states": str(root / f"init_files-{_states_digest()}"),
        "datasets": str(demos_dir()),
        "assets": str(assets_folder() or Path(__file__).parents[2] / "libero" / "assets"),
    }


def ensure(key: str, path: str) -> None:
    """Write the files if `path` is a default folder and they are missing; of demonstrations, write links."""
    if key == "datasets" and path == generated_paths()[key]:
        _link_demos(Path(path))
    writers: dict[str, Callable[[Path], None]] = {"bddl_files": _write_tasks, "init_states": _write_states}
    if key in writers and path == generated_paths()[key] and not (Path(path) / _COMPLETE).exists():
        writers[key](Path(path))
        (Path(path) / _COMPLETE).touch()


def _link_demos(root: Path) -> None:
    """Link recorded demonstrations to where the original has them, `<suite>/<task>_demo.hdf5`.

    A recording is in a folder that is named by what it depends on. Of several, the latest with images of 128 pixels
    and the default seed is linked; of others, the latest.
    """
    usual = "128x128-seed0-"
    for suite in (root / name for name in suite_tasks() if (root / name).is_dir()):
        folders = [folder for folder in suite.iterdir() if folder.is_dir() and "-seed" in folder.name]
        folders.sort(key=lambda f: (f.name.startswith(usual), f.stat().st_mtime))
        files = {file.name: file for folder in folders for file in folder.glob("*_demo.hdf5")}
        for name, file in files.items():
            link, target = suite / name, Path(file.parent.name, name)
            if (link.exists() and not link.is_symlink()) or (link.is_symlink() and link.readlink() == target):
                continue
            with (
                suppress(OSError),
                atomic_path(link) as temporary,
            ):  # a folder that cannot be written has no links
                temporary.symlink_to(target)


def suite_tasks() -> dict[str, tuple[Task, ...]]:
    """Return suite -> tasks, for the suites that are not made of others."""
    suites = {name: get_suite(name).tasks for name in suite_names()}
    return {name: tasks for name, tasks in suites.items() if all(task.suite == name for task in tasks)}


@cache
def _tasks_digest() -> str:
    texts = [(task.id, task.name, task.bddl_text) for tasks in suite_tasks().values() for task in tasks]
    return hashlib.sha256(repr(texts).encode()).hexdigest()[:12]


def _states_digest() -> str:
    files = [path for path in map(shipped_path, suite_names()) if path.exists()]
    stamps = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(repr(stamps).encode()).hexdigest()[:12]


def _write_tasks(root: Path) -> None:
    for suite, tasks in suite_tasks().items():
        folder = root / suite
        folder.mkdir(parents=True, exist_ok=True)
        for task in tasks:
            (folder / f"{task.name}.bddl").write_text(task.bddl_text, encoding="utf-8")
        names = "".join(f"{suite}/{task.name}.bddl\n" for task in tasks)
        (folder / "tasks_info.txt").write_text(names, encoding="utf-8")


def _write_states(root: Path) -> None:
    root.mkdir(parents=True, exist_ok=True)
    for suite, tasks in suite_tasks().items():
        if not shipped_path(suite).exists():
            continue
        with np.load(shipped_path(suite), allow_pickle=False) as stored:
            for task in tasks:
                write_states(root / suite / f"{task.name}.pruned_init", stored[task.name])
