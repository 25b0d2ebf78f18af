"""Checks that need the built scene: joints, reach, and initial states."""

from collections import Counter
from contextlib import closing
from math import hypot, sqrt

import numpy as np

from libero_env.assets.arena import Workspace
from libero_env.assets.pack import BUILTIN, Pack
from libero_env.design.lint.report import Level, Report
from libero_env.errors import LiberoError, PlacementError
from libero_env.init_states.placement import collision_boxes, sample_start, settle, start_errors
from libero_env.init_states.store import load_init_states
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.history import over_time
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import Scene, build_scene, initial_qpos
from libero_env.sim.state import StateView
from libero_env.tasks import Task
from libero_env.tasks.builder import FILE
from libero_env.tasks.expression import And, Atom
from libero_env.tasks.problem import ProblemError, Region
from libero_env.timing import CONTROL_HZ

# The Panda's dimensions, [m] and [rad]: height of the shoulder above the base, upper arm and forearm (both offset by
# 82.5 mm at the elbow), largest bend of the elbow, distance of wrist and hand axes, wrist to grip point.
_SHOULDER, _UPPER, _FOREARM = 0.333, hypot(0.316, 0.0825), hypot(0.384, 0.0825)
_MAX_BEND = 2 * np.pi - (np.pi - np.arctan2(0.0825, 0.316) - np.arctan2(0.0825, 0.384) + 3.0718)
_WRIST_OUT, _HAND = 0.088, 0.205
_GRIP_HEIGHT = 0.02  # [m] grip point above the surface when it grasps an object
_MARGIN = 0.02  # [m] distance kept from the limits of the workspace
_ARM_LENGTH = _UPPER + _FOREARM + hypot(_WRIST_OUT, _HAND) - _MARGIN  # [m] shoulder to fingertips
_MAX_MOVE = 0.005  # [m] motion of an object at rest during the idle steps
_IDLE_STEPS = 10  # [control steps]
_LEVEL_TOLERANCE = 0.03  # [m] height difference up to which a shape belongs to the surface


def reach(workspace: Workspace) -> tuple[float, float]:
    """Return the smallest and largest distance from the base's axis at which a hand that points down can grasp, [m]."""
    shoulder = workspace.robot_base_pos[2] + _SHOULDER
    drop = shoulder - (workspace.surface_height + _GRIP_HEIGHT + _HAND)
    furthest = _UPPER + _FOREARM - _MARGIN
    nearest = sqrt(_UPPER**2 + _FOREARM**2 - 2 * _UPPER * _FOREARM * np.cos(_MAX_BEND)) + _MARGIN
    across = [sqrt(max(length**2 - drop**2, 0.0)) + _WRIST_OUT for length in (nearest, furthest)]
    return across[0], across[1]


def furthest_reach(workspace: Workspace) -> float:
    """Return the largest distance from the base's axis at which a hand in any orientation reaches the surface, [m]."""
    drop = workspace.robot_base_pos[2] + _SHOULDER - workspace.surface_height - _GRIP_HEIGHT
    return sqrt(max(_ARM_LENGTH**2 - drop**2, 0.0))


def check_scene(report: Report, task: Task, pack: Pack, starts: int) -> None:
    """Build the scene, check its regions, then some of its initial states."""
    try:
        scene = build_scene(task.problem, pack)
    except ProblemError as error:
        report.violations(error)
        return
    except LiberoError as error:
        report.add("error", 1, "scene", f"the scene cannot be built: {error}", "fix what it names")
        return
    _check_joints(report, scene)
    _check_tables(report, scene)
    if not report.broken:
        _check_starts(report, task, scene, starts)


def _check_joints(report: Report, scene: Scene) -> None:
    """Check that what is opened or turned on has a joint."""
    for atom, line in (*report.init(scene.problem), *report.goal(scene.problem)):
        owner = scene.owner(atom.args[0]) if atom.predicate.lower() in OPPOSITE_STATES else None
        if owner is not None and not scene.joints.get(atom.args[0]):
            remedy = "use an object with a joint, or a region on its moving part"
            report.add("error", line, "no-joint", f"{atom}: it has no joint", remedy)


def _check_tables(report: Report, scene: Scene) -> None:
    """Check that regions of the workspace are on it, and that those of the goal are within reach."""
    init = {atom.args[1]: atom.args[0] for atom in scene.problem.init if len(atom.args) == 2}
    goal = {name for atom in scene.problem.goal.atoms() for name in atom.args}
    surfaces = _surfaces(scene)
    for region in scene.problem.regions:
        placed = init.get(region.address)
        if not region.ranges or (placed is None and region.address not in goal):
            continue
        if placed in scene.fixtures and region.address not in goal:
            continue  # furniture may stand anywhere
        corners = _corners(region, scene.workspace)
        if not all(any((np.abs(xy - point) <= half).all() for point, half in surfaces) for xy in corners):
            what = f"{region.address} is not all on the {scene.workspace.name}"
            remedy = "move or shrink it; x points away from the robot, y to its left"
            report.add("error", report.lines.line("", region.address), "off-table", what, remedy)
        _check_reach(report, scene, region, corners, region.address in goal or placed in goal)


def _check_reach(report: Report, scene: Scene, region: Region, corners: np.ndarray, needed: bool) -> None:
    """Check that the arm can grasp from above in all of a region; it is an error where it cannot reach any of it."""
    near, far = reach(scene.workspace)
    base = np.array(scene.workspace.robot_base_pos[:2])
    middle = corners.reshape(-1, 4, 2).mean(axis=1)
    away = np.linalg.norm(np.concatenate([corners, middle]) - base, axis=1)
    if ((near <= away) & (away <= far)).all():
        return
    level: Level = "error" if away.min() > furthest_reach(scene.workspace) else "warning"
    x, y = base - np.array(scene.workspace.offset[:2])
    what = f"{region.address} is {away.min():.2f} to {away.max():.2f} m from the robot"
    remedy = f"a hand that points down reaches {near:.2f} to {far:.2f} m from ({x:g}, {y:g}), in the region's frame"
    line = report.lines.line("", region.address)
    report.add(level if needed else "info", line, "out-of-reach", what, remedy)


def _corners(region: Region, workspace: Workspace) -> np.ndarray:
    """Return the corners of all rectangles in the world frame, (4n, 2) [m]."""
    corners = [(x, y) for x0, y0, x1, y1 in region.ranges for x in (x0, x1) for y in (y0, y1)]
    return np.array(corners) + np.array(workspace.offset[:2])


def _surfaces(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the top surfaces of the workspace: centre (2,) and half extents (2,) in the world frame, [m]."""
    data, height = mujoco.MjData(scene.model), scene.workspace.surface_height
    data.qpos[:] = initial_qpos(scene)
    mujoco.mj_kinematics(scene.model, data)
    boxes = collision_boxes(scene, data, scene.workspace_name)
    return [(centre, half) for centre, half, top in boxes if abs(top - height) < _LEVEL_TOLERANCE]


def _check_starts(report: Report, task: Task, scene: Scene, starts: int) -> None:
    """Check initial states: they exist, are at rest, their atoms hold, and the goal does not."""
    faults, checked, stored = Counter[tuple[str, str]](), False, None
    if task.suite != FILE and scene.pack.name == BUILTIN:
        stored = load_init_states(task, scene)[:starts]
        starts = len(stored)
    with closing(LoopSimulations(scene.model, fixture_bodies=scene.fixture_bodies.tolist())) as simulations:
        view = StateView(scene, simulations)
        try:
            for i in range(starts):
                try:
                    _set_start(scene, simulations, None if stored is None else stored[i], i, faults)
                except PlacementError as error:
                    faults["placement", str(error)] += 1
                    continue
                faults.update(("start", fault) for fault in start_errors(view))
                if not checked:
                    _check_goal(report, scene, view)
                checked = True
        except LiberoError as error:
            report.add("error", report.lines.line(":init"), "start", str(error), "fix what it names")
    for (rule, what), count in faults.items():
        _report_start(report, scene, rule, what, count, starts)


def _set_start(
    scene: Scene,
    simulations: LoopSimulations,
    stored: np.ndarray | None,
    i: int,
    faults: Counter[tuple[str, str]],
) -> None:
    """Set the simulation to a stored initial state, or else to that sampled with seed i after settling.

    Objects that move at first are counted in `faults`.

    Raises:
        PlacementError: No state can be sampled, or it does not come to rest.
    """
    still = np.zeros((1, scene.model.nv))
    if stored is not None:
        qpos, _, (fixtures,) = scene.split_states(stored[None])
    else:
        start = sample_start(scene, np.random.default_rng(i))
        qpos, fixtures = start.qpos[None], start.fixtures
    simulations.reset([0], qpos, still, fixtures=fixtures[None])
    faults.update(("unstable-start", name) for name in _moving(scene, simulations))
    if stored is None:
        qpos = settle(simulations, 0, qpos[0], scene.nq_robot, fixtures)[None]
    simulations.reset([0], qpos, still, fixtures=fixtures[None])


def _moving(scene: Scene, simulations: LoopSimulations) -> list[str]:
    """Return the names of objects that move while the arm is idle."""
    view = StateView(scene, simulations)
    before = {name: view.body_pos(name) for name in scene.objects}
    for _ in range(_IDLE_STEPS):
        simulations.step([0], np.zeros((1, 7)))
    return [name for name, pos in before.items() if np.linalg.norm(view.body_pos(name) - pos) > _MAX_MOVE]


def _report_start(report: Report, scene: Scene, rule: str, what: str, count: int, starts: int) -> None:
    """Report a fault of initial states: an error if all have it, a warning if only some have (they are resampled)."""
    level: Level = "error" if count == starts else "warning"
    atoms = list(report.init(scene.problem))
    line = next((at for atom, at in atoms if str(atom) in what), report.lines.line(":init"))
    if rule == "unstable-start":
        level = "warning"
        line = next((at for atom, at in atoms if atom.args[0] == what), line)
        what = (
            f"{what} moves by more than {1000 * _MAX_MOVE:.0f} mm in the first {_IDLE_STEPS / CONTROL_HZ:g} s"
        )
        remedy = "place it where it is flat and wide enough to carry it"
    elif rule == "placement":
        remedy = "see the message"
    elif not what.startswith("("):  # of the goal, not of an init atom
        level, rule, line = "error", "goal-at-start", report.lines.line(":goal")
        remedy = "change the initial conditions so that the goal does not hold"
    else:
        remedy = "place it where it stays, or remove the atom"
    report.add(level, line, rule, f"{what}, in {count} of {starts} starts", remedy)


def _check_goal(report: Report, scene: Scene, view: StateView) -> None:
    """Report parts that hold at the start, and objects and regions beyond the arm's length in any orientation."""
    goal = scene.problem.goal
    if part := next(over_time(goal), None):
        what = f"{part} is of this package: the original's reader refuses such a goal"
        report.add("warning", report.lines.line(":goal"), "over-time", what, "correct if it is only run here")
    for part in goal.parts if isinstance(goal, And) and len(goal.parts) > 1 else ():
        if isinstance(part, Atom) and evaluate(part, view):
            what = f"{part} holds from the beginning"
            remedy, line = "correct if it is intended to stay so", report.lines.line(":goal")
            report.add("info", line, "goal-at-start", what, remedy)
    shoulder = np.array(scene.workspace.robot_base_pos) + (0.0, 0.0, _SHOULDER)
    for atom, line in report.goal(scene.problem):
        for name in atom.args:
            if name in scene.entities:
                pos = view.body_pos(name)
            elif mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_SITE, name) >= 0:
                pos = view.site_pos(name)
            else:
                continue
            if (away := float(np.linalg.norm(pos - shoulder))) > _ARM_LENGTH:
                what = f"{name} is {away:.2f} m from the arm's shoulder, which reaches {_ARM_LENGTH:.2f} m"
                report.add("warning", line, "out-of-reach", what, "move it towards the robot")
