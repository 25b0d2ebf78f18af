"""The fixed initial states of each task: complete, settled, and tied to the model they were made for."""

import hashlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from importlib import resources
from multiprocessing import get_context
from pathlib import Path

import mujoco
import numpy as np
from tqdm import tqdm

from libero_env.assets import BUILTIN
from libero_env.errors import LiberoError, PlacementError
from libero_env.paths import cache_dir
from libero_env.placement import Start, sample_start
from libero_env.predicates import StateView, evaluate
from libero_env.problem import Region
from libero_env.scene import Scene, build_scene
from libero_env.simulation import LoopSimulations, Simulations
from libero_env.tasks.suites import Task

NUM_INIT_STATES = 50
_STILL = 2e-4  # m (or quaternion units): what may change in half a second at rest
_MAX_SETTLE = 10  # half seconds
_MAX_DRAWS = 20
_TOLERANCE = 0.02  # m, how far out of its rectangle a start may have slid
_RESERVED = 0x1B3E0  # separates the seeds of these states from those of `reset(seed=...)`


def settle(
    simulations: Simulations, i: int, qpos: np.ndarray, nq_robot: int, fixtures: np.ndarray | None = None
) -> np.ndarray:
    """Let the objects of one simulation come to rest while the arm holds its pose; (nq,) -> (nq,).

    Arm and gripper are as they were before; fixtures (nfixtures, 7) are put where they belong first.

    Raises:
        PlacementError: something still moves after five seconds.
    """
    nv, still = simulations.model.nv, np.zeros((simulations.num, 7))
    simulations.reset(
        [i], qpos[None], np.zeros((1, nv)), fixtures=None if fixtures is None else fixtures[None]
    )
    for _ in range(_MAX_SETTLE):
        before = simulations.fields["qpos"][i].copy()
        for _ in range(10):
            simulations.step([i], still)
        after = simulations.fields["qpos"][i].copy()
        if np.abs(after - before)[nq_robot:].max(initial=0.0) < _STILL:
            after[:nq_robot] = qpos[:nq_robot]
            return after
    raise PlacementError(
        f"objects still move after {_MAX_SETTLE * 0.5:.0f} s; do their regions lie on a surface?"
    )


def sample_settled(scene: Scene, simulations: Simulations, i: int, rng: np.random.Generator) -> Start:
    """A start drawn from the task's regions and settled in simulation i; its init atoms hold and its goal does not.

    Raises:
        PlacementError: as `sample_start`; or no draw in 20 comes to rest where it should.
    """
    view, why = StateView(scene, simulations, i), ""
    for _ in range(_MAX_DRAWS):
        start = sample_start(scene, rng)
        try:
            qpos = settle(simulations, i, start.qpos, scene.nq_robot, start.fixtures)
        except PlacementError as error:
            why = str(error)
            continue
        simulations.reset([i], qpos[None], np.zeros((1, simulations.model.nv)))
        if not (why := "; ".join(start_faults(view))):
            return Start(qpos, start.fixtures)
    raise PlacementError(
        f"{scene.problem.language!r}: no start in {_MAX_DRAWS} draws is as the task says: {why}"
    )


def start_faults(view: StateView) -> list[str]:
    """What is wrong with a state as a start: init atoms that do not hold, a goal that does."""
    faults = []
    for atom in view.scene.problem.init:
        if atom.args[0] in view.scene.fixtures:
            continue
        region = view.scene.problem.region(atom.args[-1])
        if atom.predicate == "On" and region is not None:
            holds = _stands_on(view, atom.args[0], region)
        else:
            holds = evaluate(atom, view)
        if not holds:
            faults.append(f"({atom.predicate} {' '.join(atom.args)}) does not hold")
    if evaluate(view.scene.problem.goal, view):
        faults.append("the goal holds already")
    return faults


def _stands_on(view: StateView, name: str, region: Region) -> bool:
    """Over the region as seen from above, and touching its target; the heights that `On` asks for do not count."""
    if region.ranges:
        point = view.body_pos(name)[:2] - np.asarray(view.scene.workspace.offset)[:2]
        low, high = np.split(np.array(region.ranges), 2, axis=1)
        return bool(((point > low - _TOLERANCE) & (point < high + _TOLERANCE)).all(axis=1).any())
    half = np.abs(view.site_mat(region.address) @ view.scene.model.site(region.address).size)
    near = np.abs(view.body_pos(name) - view.site_pos(region.address))[:2] < half[:2]
    return bool(near.all()) and view.in_contact(name, region.target)


def generate_init_states(task: Task, scene: Scene, num: int = NUM_INIT_STATES) -> np.ndarray:
    """The initial states of a task, made anew: (num, 1 + nq + nv + 7 nfixtures).

    Rows are [time, qpos, qvel, pos and quat (wxyz) of each fixture]; row i depends on the task's name and i alone.
    """
    simulations, nv = LoopSimulations(scene.model, fixture_bodies=scene.fixture_bodies), scene.model.nv
    name = int.from_bytes(hashlib.sha256(task.name.encode()).digest()[:8], "big")
    rows = []
    for i in range(num):
        start = sample_settled(scene, simulations, 0, np.random.default_rng([_RESERVED, name, i]))
        rows.append(np.concatenate([[0.0], start.qpos, np.zeros(nv), start.fixtures.ravel()]))
    return np.array(rows)


def split_row(model: mujoco.MjModel, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (k, n) of initial states -> qpos (k, nq), qvel (k, nv), fixtures (k, nfixtures, 7)."""
    _, qpos, qvel, fixtures = np.split(rows, np.cumsum([1, model.nq, model.nv]), axis=1)
    return qpos, qvel, fixtures.reshape(len(rows), -1, 7)


def load_init_states(task: Task, scene: Scene) -> np.ndarray:
    """The task's 50 initial states, rows as of `generate_init_states`: those shipped, else made once and cached.

    Raises:
        LiberoError: the shipped states were made for another model.
    """
    digest = scene_digest(scene)
    shipped = _shipped(task.suite).get(task.name)
    if shipped is not None and (shipped[0] == digest or scene.pack.name == BUILTIN):
        if shipped[0] != digest:
            raise LiberoError(
                f"the initial states of {task.id} were made for another model ({shipped[0]}, this one is {digest}); "
                f"make them anew: libero tasks init-states {task.suite}"
            )
        return shipped[1]
    path = _cached_path(task, digest)
    if path.exists():
        with np.load(path, allow_pickle=False) as stored:
            return stored["states"]
    states = generate_init_states(task, scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, {"states": states})
    return states


def cache_init_states(task: Task) -> Path:
    """Make the initial states of a task that none are shipped for, unless they are there, and say where."""
    scene = build_scene(task.problem)
    load_init_states(task, scene)
    return _cached_path(task, scene_digest(scene))


def _cached_path(task: Task, digest: str) -> Path:
    said = hashlib.sha256(task.bddl_text.encode()).hexdigest()[
        :16
    ]  # regions and atoms, which the digest knows not
    return cache_dir() / "init_states" / f"{task.name[:80]}-{digest}-{said}.npz"


def write_suite(path: Path, tasks: Sequence[Task], jobs: int = 1) -> None:
    """Make the initial states of tasks and write them to one npz: `<task>` states, `<task>.digest`.

    Args:
        path: the file.
        tasks: of one suite.
        jobs: processes; the states do not depend on it.
    """
    arrays: dict[str, np.ndarray] = {}
    path.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        made = zip(tasks, pool.map(_generate, tasks), strict=True)
        for task, (states, digest) in tqdm(made, unit="task", desc="initial states", total=len(tasks)):
            arrays[task.name], arrays[f"{task.name}.digest"] = states, np.array(digest)
    _write(path, arrays)


def _generate(task: Task) -> tuple[np.ndarray, str]:
    scene = build_scene(task.problem)
    return generate_init_states(task, scene), scene_digest(scene)


def shipped_path(suite: str) -> Path:
    """Where the package keeps the initial states of a suite."""
    return Path(str(resources.files("libero_env"))) / "tasks" / "init_states" / f"{suite}.npz"


def scene_digest(scene: Scene) -> str:
    """What initial states depend on: joints in order, collision shapes of objects and fixtures; 16 hex digits."""
    model = scene.model
    parts = [(model.joint(j).name, int(model.jnt_type[j])) for j in range(model.njnt)]
    for name, thing in scene.things.items():
        if thing.digest:
            parts.append((name, thing.digest))
        for body in scene.bodies[name]:
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
