"""Starts that are at rest: sampled placements, simulated until nothing moves, and checked against the task."""

import numpy as np

from libero_env.errors import PlacementError
from libero_env.init_states.placement import Start, sample_start
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Region

_STILL = 2e-4  # m (or quaternion units): what may change in half a second at rest


_MAX_SETTLE = 10  # half seconds


_MAX_DRAWS = 20


_TOLERANCE = 0.02  # m, how far out of its rectangle a start may have slid


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
