"""The tasks of this package as files of the original: `<suite>/<task>.bddl`, `<suite>/<task>.pruned_init`."""

import codecs
import hashlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from libero._adapters.models import assets_folder, facade_robot
from libero_env.demos.config import DemoConfig
from libero_env.demos.contents import json_attribute, read_header
from libero_env.demos.generate import demo_path
from libero_env.errors import DemoError, LiberoError
from libero_env.init_states.pickles import states_content
from libero_env.init_states.store import packaged_states, shipped_path
from libero_env.paths import cache_dir, demos_dir
from libero_env.storage import (
    atomic_path,
    check_trusted,
    make_cache_folder,
    open_for_owner,
    read_record,
    write_record,
)
from libero_env.tasks import Task, get_suite, suite_names

_COMPLETE = ".complete"  # digests of all files; written last, so after an interruption all are compared again
_log = logging.getLogger(__name__)


def generated_paths() -> dict[str, str]:
    """Return the default folders of task files, initial states, demonstrations and assets; nothing is written."""
    root = cache_dir() / "facade"
    return {
        "bddl_files": str(root / f"bddl_files-{_tasks_digest()}"),
        "init_states": str(root / f"init_files-{_states_digest()}"),
        "datasets": str(demos_dir()),
        "assets": str(assets_folder() or Path(__file__).parents[1] / "libero" / "assets"),
    }


def ensure(key: str, path: str) -> None:
    """Write the files if `path` is a default folder and they are missing or damaged; of demonstrations, write links.

    Raises:
        LiberoError: The files cannot be written, or another user can have written them.
    """
    if path != generated_paths().get(key):
        return
    if key == "datasets":
        _link_demos(Path(path))
    elif key in _CONTENTS and not (path in _checked and (Path(path) / _COMPLETE).exists()):
        _ensure_files(Path(path), _CONTENTS[key])
        _checked.add(path)


_checked: set[str] = set()  # folders whose files this process has compared


def _ensure_files(root: Path, contents: Callable[[], Iterator[tuple[str, bytes]]]) -> None:
    """Compare files with what they had when they were written, and write those that differ again."""
    check_trusted(root.parent)
    written = read_record(root / _COMPLETE) or {}
    if written and all(_digest(root / name) == digest for name, digest in written.items()):
        return
    try:
        digests = {name: _replace(root / name, content) for name, content in contents()}
        write_record(root / _COMPLETE, digests)
    except OSError as error:
        raise LiberoError(
            f"{root}: the files of the tasks cannot be written there ({error.strerror or error}); set LIBERO_CACHE to "
            "a folder that you can write to"
        ) from error


def _replace(path: Path, content: bytes) -> str:
    """Write a file unless it has this content; a file with other content, perhaps somebody's own, is kept beside it."""
    digest = hashlib.sha256(content).hexdigest()
    if (present := _digest(path)) != digest:
        if present is not None:
            backup = path.with_name(f"{path.name}.changed")
            path.replace(backup)
            _log.warning("%s has changed since it was written; it is kept as %s", path, backup.name)
        make_cache_folder(path.parent)
        with atomic_path(path) as temporary, open(temporary, "wb", opener=open_for_owner) as file:
            file.write(content)
    return digest


def _digest(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def _link_demos(root: Path) -> None:
    """Link recorded demonstrations to where the original has them, `<suite>/<task>_demo.hdf5`.

    A recording is in a folder that is named by what it depends on. Of several, that with the default configuration is
    linked; else the latest with images of 128 pixels and the default seed; else the latest. None is linked that starts
    in the stored states, from which policies are evaluated.
    """
    usual = "128x128-seed0-"
    for suite_name, tasks in suite_tasks().items():
        if not (suite := root / suite_name).is_dir():
            continue
        default = demo_path(root, DemoConfig(tasks[0], robot=facade_robot())).parent
        folders = [f for f in suite.iterdir() if f.is_dir() and "-seed" in f.name and not _is_reserved(f)]
        folders.sort(key=lambda f: (f == default, f.name.startswith(usual), f.stat().st_mtime))
        files = {file.name: file for folder in folders for file in folder.glob("*_demo.hdf5")}
        for name, file in files.items():
            link, target = suite / name, Path(file.parent.name, name)
            ours = is_recording(link)
            if (os.path.lexists(link) and not ours) or (ours and link.readlink() == target):
                continue
            with suppress(OSError), atomic_path(link) as temporary:  # what cannot be written has no links
                temporary.symlink_to(target)


def is_recording(path: Path) -> bool:
    """Return whether a path is a link to what was recorded here, and not a file, or link, of the user's."""
    target = path.readlink().parts if path.is_symlink() else ()
    return len(target) == 2 and "-seed" in target[0]


def _is_reserved(folder: Path) -> bool:
    """Return whether the recordings in a folder start in the stored initial states."""
    with suppress(DemoError, StopIteration):
        file = next(folder.glob("*_demo.hdf5"))
        return bool(json_attribute(read_header(file), "variation", file).get("reserved"))
    return False


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


def _task_files() -> Iterator[tuple[str, bytes]]:
    for suite, tasks in suite_tasks().items():
        for task in tasks:
            yield f"{suite}/{task.name}.bddl", task.bddl_text.encode()
        yield f"{suite}/tasks_info.txt", "".join(f"{suite}/{task.name}.bddl\n" for task in tasks).encode()


def _state_files() -> Iterator[tuple[str, bytes]]:
    for suite, tasks in suite_tasks().items():
        stored = packaged_states(suite)
        for task in tasks if stored else ():
            yield f"{suite}/{task.name}.pruned_init", states_content(stored[task.name][1], task.name)


_CONTENTS = {"bddl_files": _task_files, "init_states": _state_files}


def allow_arrays() -> None:
    """Let a bare `torch.load` read NumPy arrays, as initial states and results of the original are stored.

    Since PyTorch 2.6 it refuses them unless their classes are registered. Nothing is done before the client has
    imported torch. The registered names build arrays of numbers and execute nothing else.
    """
    torch: Any = sys.modules.get("torch")
    register = getattr(getattr(torch, "serialization", None), "add_safe_globals", None)
    if register is None:
        return
    rebuild = np.zeros(0).__reduce__()[0]
    numbers = [type(np.dtype(code)) for code in ("f8", "f4", "i8", "i4", "u1", "?")]
    scalar = np.float64(0).__reduce__()[0]
    named = [(rebuild, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")]
    named += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    register([*named, np.ndarray, np.dtype, codecs.encode, *numbers])
