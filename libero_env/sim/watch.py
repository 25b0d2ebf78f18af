"""What the whole state shows of episodes: touched, lifted, dropped, hit, costs. It reads, and moves no bit.

It looks at the end of each control step. What happens in between, such as a short blow, is not seen.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import compress

import numpy as np

from libero_env.assets.robot import FINGER_JOINTS
from libero_env.geometry import quat_rotate
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.causes import HARD, Failure, Missing, Trace, explain
from libero_env.sim.costs import LIMITS, Costs
from libero_env.sim.predicates import PREDICATES, contains, ground, is_over, region_boxes
from libero_env.sim.scene import ROBOT, Scene
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom, Expression, Never
from libero_env.timing import TIMESTEP

LIFTED = 0.02  # [m] above the height at the start
OVER = 0.30  # [m] above its place, an object is over it
NEAR = 0.06  # [m] from the fingertips to an object's box while they close on nothing: a grasp that missed
SHUT = 0.01  # [m] between fingers that have nothing between them
_CLOSING = 0.0002  # [m] by which they come nearer to each other in a step, at least
_CONJUGATE = (1.0, -1.0, -1.0, -1.0)  # of a quaternion, wxyz
_MOVED = 0.02  # [rad] or [m] that a joint of a fixture was moved
_LEFT, _RIGHT, _HAND, _ARM = "left finger", "right finger", "hand", "arm"
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)  # all that a step depends on


class EpisodeWatch:
    """Traces of the episodes of several simulations of one scene.

    Args:
        views: State view of each simulation.
        atoms: Atoms of the goal, or of several goals.

    Attributes:
        traces: What the present episode of each simulation has shown.
        costs: What it has cost.
        goals: Atoms of the goal of each simulation.
    """

    def __init__(self, views: Sequence[StateView], atoms: Sequence[Atom]):
        self.views, self._scene, self.atoms = views, views[0].scene, tuple(atoms)
        scene, model = self._scene, self._scene.model
        self._names, self._first = [*scene.bodies, _LEFT, _RIGHT, _HAND, _ARM], len(scene.bodies)
        self._codes = np.zeros(model.nbody, np.int64)  # of each body, the index of its name
        for code, bodies in enumerate(scene.bodies.values()):
            self._codes[bodies] = code
        first, second = (model.joint(name).bodyid[0] for name in FINGER_JOINTS)
        for body in scene.bodies[ROBOT]:
            part = _HAND if model.body(body).name.startswith("gripper0_") else _ARM
            part = _LEFT if first in ancestors(model, body) else part
            part = _RIGHT if second in ancestors(model, body) else part
            self._codes[body] = self._names.index(part)
        goal = ground(scene.problem.goal, scene)
        forbidden = {*goal.atoms()} - {*goal.wanted()}
        self.goals = [tuple(atom for atom in self.atoms if atom not in forbidden) for _ in views]
        self._owned = {j: name for name in scene.entities for j in scene.joints[name]}
        self._joints = model.jnt_qposadr[list(self._owned)]
        self._scratch: mujoco.MjData | None = None
        about = {*self.atoms} - forbidden
        self._named = {scene.owner(name) for atom in about for name in atom.args}
        self._idle = [name for name in scene.objects if name not in self._named]
        addresses = [scene.pose_address(name) for name in self._idle]
        self._poses = np.reshape(addresses, (-1, 1)).astype(int) + np.arange(7)
        self._free = np.array([name not in self._named for name in self._owned.values()], bool)
        free = [name for name, is_free in zip(self._owned.values(), self._free, strict=True) if is_free]
        self._others = np.array([*self._idle, *free], object)
        self._roots = [int(scene.bodies[name][0]) for name in scene.objects]
        self._reach = [_reach(scene, name) + NEAR for name in scene.objects]
        self._slides = model.jnt_type[list(self._owned)] == mujoco.mjtJoint.mjJNT_SLIDE
        self._stood = np.zeros((len(views), len(self._idle), 3))
        self._uprights = np.zeros_like(self._stood)  # the vertical at the start, in their frames
        self.traces, self.costs = [Trace() for _ in views], [Costs() for _ in views]
        self._heights: list[dict[str, float]] = [{} for _ in views]
        self._rest = np.zeros((len(views), len(self._joints)))
        self._widths, self._apart = np.zeros(len(views)), np.zeros(len(views))
        self._nearest: list[tuple[float, str]] = [
            (np.inf, "") for _ in views
        ]  # since the fingers began to close
        for i in range(len(views)):
            self.begin(i)

    def begin(self, i: int) -> None:
        """Begin the trace of an episode in the present state of simulation i."""
        view = self.views[i]
        self.traces[i], self.costs[i] = Trace(), Costs(zone=0.0 if self._scene.problem.zones else None)
        self._heights[i] = {name: float(view.body_pos(name)[2]) for name in self._scene.objects}
        self._rest[i] = view.simulations.fields["qpos"][i, self._joints]
        self._apart[i], self._nearest[i] = np.abs(view.finger_pos).sum(), (np.inf, "")
        self.measure_from_here(i)

    def measure_from_here(self, i: int) -> None:
        """Measure the displacement of objects from the present state of simulation i: an event has moved some."""
        poses = self.views[i].simulations.fields["qpos"][i][self._poses]
        vertical = np.tile([0.0, 0.0, 1.0], (len(poses), 1))
        self._stood[i], self._uprights[i] = poses[:, :3], quat_rotate(poses[:, 3:] * _CONJUGATE, vertical)

    def memory(self, i: int) -> np.ndarray:
        """Return what triggers of events depend on beside the present state of simulation i, for `recall`."""
        trace, objects = self.traces[i], self._scene.objects
        seen = [name in trace.touched for name in self._scene.entities]
        seen += [name in trace.lifted for name in objects] + [name == trace.in_hand for name in objects]
        return np.array([*self._heights[i].values(), *seen], float)

    def recall(self, i: int, memory: np.ndarray) -> None:
        """Go on with the episode of simulation i, which has begun anew, as `memory` says."""
        trace, objects, entities = self.traces[i], self._scene.objects, self._scene.entities
        heights, *seen = np.split(memory, np.cumsum([len(objects), len(entities), len(objects)]))
        self._heights[i] = dict(zip(objects, heights.tolist(), strict=True))
        trace.touched = {name for name, yes in zip(entities, seen[0], strict=True) if yes}
        trace.lifted = {name: None for name, yes in zip(objects, seen[1], strict=True) if yes}
        trace.in_hand = next((name for name, yes in zip(objects, seen[2], strict=True) if yes), None)

    def wanted(self, i: int) -> list[str]:
        """Return the objects and fixtures that the goal of simulation i is about."""
        return [name for atom in self.goals[i] if (name := self._scene.owner(atom.args[0]))]

    def look(self, i: int) -> Trace:
        """Take note of the present state of simulation i, after a control step, and return its trace."""
        trace, view = self.traces[i], self.views[i]
        trace.steps += 1
        pairs = self._pairs(view.simulations.contact_geoms(i))
        touching = self._touching(pairs)
        trace.touching = {b for a, b in touching if a in (_LEFT, _RIGHT, _HAND)}
        trace.touched |= trace.touching
        width = float(np.abs(view.finger_pos).sum())
        if trace.in_hand is not None and not touching & {(_LEFT, trace.in_hand), (_RIGHT, trace.in_hand)}:
            if trace.in_hand in trace.lifted:
                # closed, for nothing is between
                trace.slipped[trace.in_hand] = width < float(self._widths[i])
            trace.in_hand = None
        for name in self._scene.objects:
            if {(_LEFT, name), (_RIGHT, name)} <= touching:
                trace.in_hand, trace.held[name], self._widths[i] = name, trace.steps, width
                if view.body_pos(name)[2] > self._heights[i][name] + LIFTED:
                    trace.lifted[name] = None
                    trace.slipped.pop(name, None)
        self._note_closing(i, width)
        hits = any(b not in self._scene.objects or a in (_HAND, _ARM) for a, b in touching)
        needless: dict[str, float] = {}
        if hits or not trace.touching.isdisjoint(self._idle) or self._bears(pairs, trace.in_hand):
            pressed, needless = self._forces(i, trace.in_hand)
        if hits:
            trace.impacts += [(trace.steps, what, force) for what, force in pressed.items() if force >= HARD]
        self._add_costs(i, needless)
        return trace

    def failure(self, i: int, ever: Sequence[bool], lacking: Sequence[Expression]) -> Failure:
        """Return why the episode in simulation i has failed.

        Args:
            i: Index of the simulation.
            ever: Whether each of the atoms held at any time.
            lacking: What the goal lacks at the end, see `libero_env.sim.history.History.missing`.
        """
        trace, view = self.traces[i], self.views[i]
        held = {atom for atom, before in zip(self.atoms, ever, strict=True) if before}
        missing = [
            Missing(name, atom in held, over(view, atom), self._place(i, name))
            for atom in lacking
            if isinstance(atom, Atom) and (name := self._scene.owner(atom.args[0]))
        ]
        broken = [
            Failure("forbidden" if isinstance(one, Never) else "wrong order", what=str(one))
            for one in lacking
            if not isinstance(one, Atom)
        ]
        moved = (name for name in self.costs[i].moved if name in trace.touched)
        astray = [name for name in (*moved, *trace.shut_at, *trace.held) if name not in self._named]
        found = broken[0] if broken else explain(trace, missing, self.wanted(i), astray)
        moved = np.abs(view.simulations.fields["qpos"][i, self._joints] - self._rest[i]) > _MOVED
        opened = [name for name, far in zip(self._owned.values(), moved, strict=True) if far]
        handled = tuple(dict.fromkeys([*trace.lifted, *(name for name in opened if name in trace.touched)]))
        instead = tuple(str(atom) for atom in self._possible(i, handled) if _holds(view, atom))
        return Failure(found.cause, found.of, found.what, round(found.newtons, 1), handled, instead)

    def _note_closing(self, i: int, width: float) -> None:
        """Take note of the object to which fingers that have shut on nothing were nearest while they closed."""
        if width < self._apart[i] - _CLOSING:
            ways = self.views[i].simulations.fields["xpos"][i, self._roots] - self.views[i].eef_pos
            near = np.linalg.norm(ways, axis=1) < self._reach
            here = [(self._distance(i, name), name) for name in compress(self._scene.objects, near)]
            self._nearest[i] = min([self._nearest[i], *here])
        else:
            self._nearest[i] = (np.inf, "")
        if width < SHUT <= self._apart[i] and self._nearest[i][0] <= NEAR:
            self.traces[i].shut_at[self._nearest[i][1]] = None
        self._apart[i] = width

    def _distance(self, i: int, name: str) -> float:
        """Return the distance of the fingertips from an object's box along the world axes, [m]."""
        point, (low, high) = self.views[i].eef_pos, self.views[i].bounds(name)
        return float(np.linalg.norm(np.maximum(0.0, np.maximum(low - point, point - high))))

    def _pairs(self, geoms: np.ndarray) -> np.ndarray:
        """Return the indices of the names of what touches each other, (n, 2), parts of the robot last."""
        return np.sort(self._codes[self._scene.model.geom_bodyid[geoms]].reshape(-1, 2), axis=1)

    def _touching(self, pairs: np.ndarray) -> set[tuple[str, str]]:
        """Return the parts of the robot that touch something else, with what."""
        robot = pairs >= self._first
        pairs = pairs[robot[:, 1] & ~robot[:, 0]]
        return {(self._names[a], self._names[b]) for b, a in set(map(tuple, pairs.tolist()))}

    def _bears(self, pairs: np.ndarray, held: str | None) -> bool:
        """Return whether what the robot holds touches something other than the robot."""
        if held is None:
            return False
        code = self._names.index(held)
        return bool(((pairs == code).any(axis=1) & (pairs[:, 1] < self._first)).any())

    def _forces(self, i: int, held: str | None) -> tuple[dict[str, float], dict[str, float]]:
        """Return the sums of the normal forces on what the robot touches: all of them, and those that nothing needs.

        Fingers may press what the goal is about. What the robot holds counts as a part of it in the second. The forces
        are those of a solver that runs on a copy.
        """
        simulations = self.views[i].simulations
        model, force = simulations.model, np.zeros(6)
        pressed: dict[str, float] = {}
        needless: dict[str, float] = {}
        simulations.pose_fixtures(i)
        self._scratch = data = self._scratch or mujoco.MjData(model)
        state = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, simulations.data(i), state, _STATE)
        mujoco.mj_setState(model, data, state, _STATE)
        mujoco.mj_forward(model, data)
        for k, (a, b) in enumerate(self._pairs(data.contact.geom[: data.ncon]).tolist()):
            what, other, by_robot = self._names[a], self._names[b], b >= self._first
            if a >= self._first or not (by_robot or held in (what, other)):
                continue
            mujoco.mj_contactForce(model, data, k, force)
            newtons = abs(float(force[0]))
            if by_robot:
                pressed[what] = pressed.get(what, 0.0) + newtons
                if other in (_LEFT, _RIGHT) and what in self._named:
                    continue
            elif what == held:
                what = other
            needless[what] = needless.get(what, 0.0) + newtons
        return pressed, needless

    def _add_costs(self, i: int, needless: Mapping[str, float]) -> None:
        """Add the present state to the costs of an episode.

        Args:
            i: Index of the simulation.
            needless: Normal force of the robot, or what it holds, on what it touches and need not.
        """
        cost, qpos = self.costs[i], self.views[i].simulations.fields["qpos"][i]
        poses, moved = qpos[self._poses], np.abs(qpos[self._joints] - self._rest[i])
        heights = quat_rotate(poses[:, 3:], self._uprights[i])[:, 2]
        slid, turned = np.where(self._slides, moved, 0.0), np.where(self._slides, 0.0, moved)
        shifts = np.round([*np.linalg.norm(poses[:, :3] - self._stood[i], axis=1), *slid[self._free]], 4)
        tilts = np.round(np.degrees([*np.arccos(np.clip(heights, -1.0, 1.0)), *turned[self._free]]), 1)
        beyond = self._others[(shifts > LIMITS["shift"]) | (tilts > LIMITS["tilt"])]
        force = max((needless.get(name, 0.0) for name in self._idle), default=0.0)
        press = max(
            (newtons for name, newtons in needless.items() if name not in self._scene.objects), default=0.0
        )
        zone = cost.zone
        if zone is not None and self._is_in_zone(i):
            zone = round(zone + TIMESTEP * self.views[i].simulations.substeps, 3)
        self.costs[i] = Costs(
            force=max(cost.force, round(force, 1)),
            shift=float(shifts.max(initial=cost.shift)),
            tilt=float(tilts.max(initial=cost.tilt)),
            hits=cost.hits + (press >= HARD),
            press=max(cost.press, round(press, 1)),
            zone=zone,
            moved=tuple(dict.fromkeys((*cost.moved, *beyond))),
        )

    def _is_in_zone(self, i: int) -> bool:
        """Return whether a part of the robot, or what it holds, is in or over a zone."""
        view, held = self.views[i], self.traces[i].in_hand
        points = [*view.simulations.fields["xpos"][i, self._scene.bodies[ROBOT]], view.eef_pos]
        points += [view.body_pos(held)] if held else []
        return any(
            (contains(box, np.array(points)) | is_over(box, np.array(points), OVER)).any()
            for zone in self._scene.problem.zones
            for box in region_boxes(view, zone)
        )

    def _place(self, i: int, name: str) -> str:
        """Return what an object touches, rather something on the workspace than that; empty if nothing."""
        view, scene = self.views[i], self._scene
        there = [*(n for n in scene.entities if n != name), scene.workspace_name]
        return next((other for other in there if view.in_contact(name, other)), "")

    def _possible(self, i: int, handled: Sequence[str]) -> Iterator[Atom]:
        """Yield what a goal could say of the things that were handled, and the goal does not."""
        scene = self._scene
        regions = [region.address for region in scene.problem.regions if scene.is_place(region)]
        for name in handled:
            if name in scene.objects:
                candidates = [
                    Atom("On", (name, target)) for target in (*scene.entities, *regions) if target != name
                ]
                candidates += [Atom("In", (name, region)) for region in regions]
            else:
                words = [
                    state.capitalize()
                    for state in OPPOSITE_STATES
                    if state in scene.entities[name].articulation
                ]
                parts = [name, *(r for r in regions if scene.owner(r) == name and scene.joints.get(r))]
                candidates = [Atom(word, (part,)) for word in words for part in parts]
            yield from (atom for atom in candidates if atom not in self.goals[i])


def over(view: StateView, atom: Atom) -> bool:
    """Return whether an object is over or in the place where an atom of a goal wants it, up to `OVER` above it."""
    if atom.predicate not in ("On", "In") or atom.args[0] not in view.scene.objects:
        return False
    point, target = view.body_pos(atom.args[0]), atom.args[1]
    if view.is_entity(target):
        offset = point - view.body_pos(target)
        low, high = view.bounds(target)
        return bool(((point > low) & (point < high))[:2].all() and 0 <= offset[2] < OVER)
    return any(contains(box, point) or is_over(box, point, OVER) for box in region_boxes(view, target))


def _holds(view: StateView, atom: Atom) -> bool:
    return bool(PREDICATES[atom.predicate](view, *atom.args))


def _reach(scene: Scene, name: str) -> float:
    """Return how far the box of an object along the world axes reaches from its root in any pose, [m]."""
    model, geoms = scene.model, scene.collision_geoms[name]
    if (model.geom_bodyid[geoms] != scene.bodies[name][0]).any():
        return np.inf  # it has parts, which may move
    centres, halves = np.split(model.geom_aabb[geoms], 2, axis=1)
    parts = (np.linalg.norm(values, axis=1) for values in (model.geom_pos[geoms], centres, halves))
    return float(np.max(sum(parts)) * np.sqrt(3.0))


def ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and all that it is part of."""
    found = set[int]()
    while body:
        found.add(int(body))
        body = model.body_parentid[body]
    return found
