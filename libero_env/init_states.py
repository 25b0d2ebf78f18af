"""The fixed initial states of each task: complete, settled, and tied to the model they were made for."""

import hashlib
from functools import lru_cache
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
from tqdm import tqdm

from libero_env.errors import LiberoError, PlacementError
from libero_env.paths import cache_dir
from libero_env.placement import sample_qpos
from libero_env.scene import Scene
from libero_env.simulation import LoopSimulations, Simulations
from libero_env.tasks.suites import Task

NUM_INIT_STATES = 50
_STILL = 2e-4  # m (or quaternion units): what may change in half a second at rest
_MAX_SETTLE = 10  # half seconds
_RESERVED = 0x1B3E0  # separates the seeds of these states from those of `reset(seed=...)`


def settle(simulations: Simulations, i: int, qpos: np.ndarray, nq_robot: int) -> np.ndarray:
    """Let the objects of one simulation come to rest while the arm holds its pose; (nq,) -> (nq,).

    Arm and gripper are as they were before.

    Raises:
        PlacementError: something still moves after five seconds.
    """
    nv, still = simulations.model.nv, np.zeros((simulations.num, 7))
    simulations.reset([i], qpos[None], np.zeros((1, nv)))
    for _ in range(_MAX_SETTLE):
        before = simulations.fields["qpos"][i].copy()
        for _ in range(10):
            simulations.step([i], still)
        after = simulations.fields["qpos"][i].copy()
        if np.abs(after - before)[nq_robot:].max(initial=0.0) < _STILL:
            after[:nq_robot] = qpos[:nq_robot]
            return after
    raise PlacementError(f"objects still move after {_MAX_SETTLE * 0.5:.0f} s; do their regions lie on a surface?")


def sample_settled(scene: Scene, simulations: Simulations, i: int, rng: np.random.Generator) -> np.ndarray:
    """Positions (nq,) drawn from the task's regions and settled in simulation i.

    Raises:
        PlacementError: as `sample_qpos` and `settle`.
    """
    return settle(simulations, i, sample_qpos(scene, rng), scene.nq_robot)


def generate_init_states(task: Task, scene: Scene, num: int = NUM_INIT_STATES) -> np.ndarray:
    """The initial states of a task, made anew: (num, 1 + nq + nv), rows as [time, qpos, qvel].

    State i depends on the task's name and i alone.
    """
    simulations = LoopSimulations(scene.model)
    name = int.from_bytes(hashlib.sha256(task.name.encode()).digest()[:8], "big")
    states = np.zeros((num, 1 + scene.model.nq + scene.model.nv))
    for i in range(num):
        rng = np.random.default_rng([_RESERVED, name, i])
        states[i, 1 : 1 + scene.model.nq] = sample_settled(scene, simulations, 0, rng)
    return states


def load_init_states(task: Task, scene: Scene) -> np.ndarray:
    """The task's 50 initial states, (50, 1 + nq + nv): those shipped with the package, else made once and cached.

    Raises:
        LiberoError: the shipped states were made for another model.
    """
    digest = scene_digest(scene)
    shipped = _shipped(task.suite).get(task.name)
    if shipped is not None:
        if shipped[0] != digest:
            raise LiberoError(
                f"the initial states of {task.id} were made for another model ({shipped[0]}, this one is {digest}); "
                f"make them anew: libero tasks init-states {task.suite}"
            )
        return shipped[1]
    path = cache_dir() / "init_states" / f"{task.name[:80]}-{digest}.npz"
    if path.exists():
        with np.load(path, allow_pickle=False) as stored:
            return stored["states"]
    states = generate_init_states(task, scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, {"states": states})
    return states


def write_suite(path: Path, tasks: list[tuple[Task, Scene]]) -> None:
    """Make the initial states of a suite and write them to one npz: `<task>` states, `<task>.digest`."""
    arrays: dict[str, np.ndarray] = {}
    path.parent.mkdir(parents=True, exist_ok=True)
    for task, scene in tqdm(tasks, unit="task", desc="initial states"):
        arrays[task.name] = generate_init_states(task, scene)
        arrays[f"{task.name}.digest"] = np.array(scene_digest(scene))
    _write(path, arrays)


def shipped_path(suite: str) -> Path:
    """Where the package keeps the initial states of a suite."""
    return Path(str(resources.files("libero_env"))) / "tasks" / "init_states" / f"{suite}.npz"


def scene_digest(scene: Scene) -> str:
    """What initial states depend on: joints in order and the collision shapes of the objects; 16 hex digits."""
    model = scene.model
    parts = [(model.joint(j).name, int(model.jnt_type[j])) for j in range(model.njnt)]
    for name in scene.objects:
        body = model.body(f"{name}_main").id
        for g in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
            if model.geom_contype[g] and model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH:
                figures = (*model.geom_size[g], *model.geom_pos[g], *model.geom_quat[g])
                parts.append((name, int(model.geom_type[g]), *(f"{value:.5f}" for value in figures)))
        parts.append((name, f"{model.body_mass[body]:.6f}"))
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


@lru_cache(maxsize=8)
def _shipped(suite: str) -> dict[str, tuple[str, np.ndarray]]:
    path = shipped_path(suite)
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as stored:
        names = [name for name in stored.files if not name.endswith(".digest")]
        return {name: (str(stored[f"{name}.digest"]), stored[name]) for name in names}


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(partial, **arrays)
    partial.replace(path)
