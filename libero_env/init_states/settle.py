"""Starts at rest: sampled placements, simulated until nothing moves, and checked against the task."""

import numpy as np

from libero_env.errors import PlacementError
from libero_env.init_states.placement import Start, fewer, sample_start
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Region

_STILL_CHANGE = 2e-4  # [m, or quaternion units] largest change of an object at rest in half a second
_MAX_HALF_SECONDS = 10
_MAX_SAMPLES = 20
_USUAL_FREEDOMS = 250  # of a scene; those with more have fewer samples, each of which takes longer
_TOLERANCE = 0.02  # [m] distance by which an object may slide out of its rectangle


def settle(
    simulations: Simulations, i: int, qpos: np.ndarray, nq_robot: int, fixtures: np.ndarray | None = None
) -> np.ndarray:
    """Simulate until the objects of one simulation are at rest, while the arm holds its pose.

    Args:
        simulations: Simulations, with a controller whose zero action holds the pose.
        i: Index of the simulation.
        qpos: Positions to start from, (nq,).
        nq_robot: Number of positions of the robot.
        fixtures: Poses of the fixtures, (nfixtures, 7); None keeps them.

    Returns:
        Positions at rest, (nq,), with those of the robot as they were.

    Raises:
        PlacementError: An object still moves after five seconds.
    """
    hold = np.zeros((simulations.num, 7))
    simulations.reset(
        [i],
        qpos[None],
        np.zeros((1, simulations.model.nv)),
        fixtures=None if fixtures is None else fixtures[None],
    )
    for _ in range(_MAX_HALF_SECONDS):
        before = simulations.fields["qpos"][i].copy()
        for _ in range(10):
            simulations.step([i], hold)
        after = simulations.fields["qpos"][i].copy()
        if np.abs(after - before)[nq_robot:].max(initial=0.0) < _STILL_CHANGE:
            after[:nq_robot] = qpos[:nq_robot]
            return after
    raise PlacementError(
        f"objects still move after {_MAX_HALF_SECONDS * 0.5:.0f} s; do their regions lie on a surface?"
    )


def sample_settled(
    scene: Scene,
    simulations: Simulations,
    i: int,
    rng: np.random.Generator,
    fixtures: np.ndarray | None = None,
) -> Start:
    """Sample a start that is at rest, where the init atoms are true and the goal is false.

    Args:
        scene: Scene to sample.
        simulations: Simulations of the scene.
        i: Index of the simulation to settle the objects in.
        rng: Random generator.
        fixtures: Poses of the fixtures, (nfixtures, 7); None samples them.

    Raises:
        PlacementError: As `sample_start`; or no sample of 20 comes to rest where it should. Scenes of unusual size have
            fewer samples.
    """
    view, reason = StateView(scene, simulations, i), ""
    samples = fewer(_MAX_SAMPLES, scene.model.nv, _USUAL_FREEDOMS)
    for _ in range(samples):
        start = sample_start(scene, rng, fixtures)
        try:
            qpos = settle(simulations, i, start.qpos, scene.nq_robot, start.fixtures)
        except PlacementError as error:
            reason = str(error)
            continue
        simulations.reset([i], qpos[None], np.zeros((1, simulations.model.nv)))
        if not (reason := "; ".join(start_faults(view))):
            return Start(qpos, start.fixtures)
    raise PlacementError(
        f"{scene.problem.language!r}: none of {samples} sampled starts agrees with the task: {reason}"
    )


def start_faults(view: StateView) -> list[str]:
    """Return the reasons why a state is no valid start: init atoms that are false, a goal that is true."""
    faults = []
    for atom in view.scene.problem.init:
        if atom.args[0] in view.scene.fixtures:
            continue
        region = view.scene.problem.region(atom.args[-1])
        if atom.predicate == "On" and region is not None:
            is_true = _rests_on(view, atom.args[0], region)
        else:
            is_true = evaluate(atom, view)
        if not is_true:
            faults.append(f"{atom} does not hold")
    if evaluate(view.scene.problem.goal, view):
        faults.append("the goal holds already")
    return faults


def _rests_on(view: StateView, name: str, region: Region) -> bool:
    """Return whether an object is over a region, seen from above, and touches its target; unlike `On` at any height."""
    if region.ranges:
        point = view.body_pos(name)[:2] - np.asarray(view.scene.workspace.offset)[:2]
        low, high = np.split(np.array(region.ranges), 2, axis=1)
        return bool(((point > low - _TOLERANCE) & (point < high + _TOLERANCE)).all(axis=1).any())
    half = np.abs(view.site_mat(region.address) @ view.scene.model.site(region.address).size)
    near = np.abs(view.body_pos(name) - view.site_pos(region.address))[:2] < half[:2]
    return bool(near.all()) and view.in_contact(name, region.target)
