"""The fixed initial states of each task: complete, settled, and valid for the model that they were made for."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

from libero_env.assets.pack import BUILTIN
from libero_env.errors import BrokenFileError, LiberoError, PlacementError
from libero_env.init_states.original_resets import drawn_fixtures
from libero_env.init_states.pickles import StateFileError, read_states
from libero_env.init_states.placement import sample_states
from libero_env.parallel import as_finished, spawn_pool
from libero_env.paths import cache_dir, read_config
from libero_env.progress import progress_bar
from libero_env.sim.scene import InitialStates, Scene, build_scene
from libero_env.storage import atomic_write_npz, cached_arrays, read_npz, read_packaged_npz
from libero_env.tasks import bddl
from libero_env.tasks.task import NUM_INIT_STATES, Task

_FIXTURE_SEED = 0  # of the poses of fixtures beside published states
_SEED = 0x1B3E0  # keeps the seeds of these states apart from those of `reset(seed=...)`


def generate_init_states(task: Task, scene: Scene, num: int = NUM_INIT_STATES) -> InitialStates:
    """Generate the initial states of a task.

    Args:
        num: Number of states.

    Returns:
        The states, of which the i-th depends on the task's name and i alone.
    """
    name = int.from_bytes(hashlib.sha256(task.name.encode()).digest()[:8], "big")
    return sample_states(scene, [np.random.default_rng([_SEED, name, i]) for i in range(num)])


def load_init_states(task: Task, scene: Scene) -> InitialStates:
    """Return the initial states of a task: those of the package, or else of the cache, where they are generated once.

    Returns:
        The 50 states; of a variant that leaves objects in place, those of its base task.

    Raises:
        LiberoError: The states of the package were made for another model, or their file is damaged.
    """
    task, digest = task.start_task, scene.digest
    packaged = packaged_states(task.suite).get(task.name)
    if packaged is not None and (packaged[0] == digest or scene.pack.name == BUILTIN):
        if packaged[0] != digest:
            raise LiberoError(
                f"the initial states of {task.id} were made for another model ({packaged[0]}, this one is {digest}); "
                f"generate them again: libero tasks init-states {task.suite}"
            )
        return packaged[1].copy()
    return cached_arrays(
        _cached_path(task, digest),
        lambda: {"states": _own_states(task, scene)},
        lambda stored: (
            set(stored) == {"states"} and stored["states"].shape == (task.num_starts, scene.state_size)
        ),
    )["states"]


def _own_states(task: Task, scene: Scene) -> np.ndarray:
    """Return generated states of a task; those that others publish for it where its objects find no place.

    Twenty-one variants of LIBERO-Plus have objects within each other, with any models.
    """
    try:
        return generate_init_states(task, scene, task.num_starts)
    except PlacementError:
        published = load_original_states(task, scene) if task.start_file else None
        if published is None:
            raise
    size = 1 + scene.model.nq + scene.model.nv
    fixtures = next(drawn_fixtures(scene, _FIXTURE_SEED, 1)).ravel()
    return np.stack([np.concatenate([row[:size], fixtures]) for row in published[: task.num_starts]])


def load_original_states(task: Task, scene: Scene | None = None) -> np.ndarray | None:
    """Return the initial states that LIBERO publishes for a task, rows [time, qpos, qvel]; None without them.

    They are in the folder `init_states` of the configuration file, laid out as LIBERO's `init_files`.

    Args:
        scene: Compiled scene that is to start in them, whose size is compared; None compares nothing.

    Raises:
        StateFileError: The task's file is broken.
        LiberoError: The states are of another model than the scene's.
    """
    if task.start_file:
        path = task.start_file
    elif folder := read_config().get("init_states"):
        path = Path(str(folder)).expanduser() / task.suite / f"{task.name}.pruned_init"
    else:
        return None
    if not path.is_file():
        return None
    if path.suffix == ".npz":  # of LIBERO-PRO's distribution
        states = read_npz(path).get("states", np.zeros(0))
        if states.ndim != 2 or states.dtype != np.float64 or not np.isfinite(states).all():
            raise StateFileError(f"{path}: expected an array `states` (n, size) of finite numbers")
    else:
        states = read_states(path)
    if scene is not None:
        scene.check_states(states, path)
    return states


def cache_init_states(task: Task) -> Path:
    """Return the file with the initial states of a task that the package has none of; they are generated once."""
    scene = build_scene(task.problem)
    load_init_states(task, scene)
    return _cached_path(task, scene.digest)


def _cached_path(task: Task, digest: str) -> Path:
    # Regions and atoms are part of the text, not of the scene's digest; cameras change no state.
    text = bddl.write(replace(task.problem, cameras=()))
    text_digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return cache_dir() / "init_states" / f"{task.name[:80]}-{digest}-{text_digest}.npz"


def write_suite(path: Path, tasks: Sequence[Task], jobs: int = 1) -> None:
    """Generate the initial states of tasks and write them to one file.

    Args:
        path: File to write, npz: for each task `<name>` with the states and `<name>.digest`.
        jobs: Number of processes; the states do not depend on it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)  # fails now, not after the work
    with spawn_pool(jobs) as pool:
        futures = [pool.submit(_generate, task) for task in tasks]
        for future in progress_bar(
            as_finished(futures), unit="task", desc="initial states", total=len(tasks)
        ):
            future.result()  # an error ends the others
    arrays: dict[str, np.ndarray] = {}
    for task, future in zip(tasks, futures, strict=True):
        states, digest = future.result()
        arrays[task.name], arrays[f"{task.name}.digest"] = states, np.array(digest)
    atomic_write_npz(path, arrays)


def _generate(task: Task) -> tuple[np.ndarray, str]:
    scene = build_scene(task.problem)
    return generate_init_states(task, scene), scene.digest


def shipped_path(suite: str) -> Path:
    """Return the file of the package with the initial states of a suite."""
    return Path(str(resources.files("libero_env"))) / "tasks" / "init_states" / f"{suite}.npz"


@lru_cache(maxsize=8)
def packaged_states(suite: str) -> dict[str, tuple[str, np.ndarray]]:
    """Return the digest of the scene and the initial states of each task of a suite; empty where it is not packaged.

    Raises:
        BrokenFileError: The file of the package is damaged.
    """
    path = shipped_path(suite)
    if not path.exists():
        return {}
    stored = read_packaged_npz(path)
    names = [name for name in stored if not name.endswith(".digest")]
    if missing := [name for name in names if f"{name}.digest" not in stored]:
        raise BrokenFileError(
            f"{path} has no digest of {missing[0]}; generate it again: libero tasks init-states {suite}"
        )
    return {name: (str(stored[f"{name}.digest"]), stored[name]) for name in names}
