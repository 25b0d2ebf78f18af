"""This package's tasks as the files that the original ships: `<suite>/<task>.bddl`, `<suite>/<task>.pruned_init`."""

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from libero_env.assets import chosen_assets
from libero_env.init_states import shipped_path
from libero_env.original_states import write_states
from libero_env.paths import cache_dir, demos_dir
from libero_env.tasks import Task, get_suite, suite_names

_COMPLETE = ".complete"  # written last, so that an interrupted layout is laid out again


def generated_paths() -> dict[str, str]:
    """Where task files, initial states, demonstrations and assets are without a configuration; not made yet."""
    root = cache_dir() / "facade"
    assets = chosen_assets().value
    return {
        "bddl_files": str(root / f"bddl_files-{_tasks_digest()}"),
        "init_states": str(root / f"init_files-{_states_digest()}"),
        "datasets": str(demos_dir()),
        "assets": assets if Path(assets).is_dir() else str(Path(__file__).parent / "assets"),
    }


def ensure(key: str, path: str) -> None:
    """Lay files out if `path` is where the generated ones belong."""
    makers: dict[str, Callable[[Path], None]] = {"bddl_files": _write_tasks, "init_states": _write_states}
    if key in makers and path == generated_paths()[key] and not (Path(path) / _COMPLETE).exists():
        makers[key](Path(path))
        (Path(path) / _COMPLETE).touch()


def task_file(name: str | os.PathLike) -> str:
    """A task file's path.

    What exists is taken as it is. Else a name without a folder, such as `Task.bddl_file`, and a path into a checkout of
    the original, `.../bddl_files/<suite>/<task>.bddl`, stand for the benchmark's file.
    """
    from libero.libero import get_libero_path

    path = Path(name)
    into_checkout = path.parts[-3:-2] == ("bddl_files",)
    if path.exists() or (path.name != str(name) and not into_checkout):
        return str(name)
    suites = [path.parent.name] if into_checkout else list(suite_tasks())
    found = [
        file for suite in suites if (file := Path(get_libero_path("bddl_files"), suite, path.name)).exists()
    ]
    return str(found[0]) if len(found) == 1 else str(name)


def suite_tasks() -> dict[str, tuple[Task, ...]]:
    """Suite with tasks of its own -> its tasks."""
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
