"""What the whole state shows of episodes: touched, lifted, dropped, hit. It reads; nothing that it does moves a bit.

It looks at the end of each control step. What happens in between, such as a short blow, is not seen.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from libero_env.assets.robot import FINGER_JOINTS
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.causes import HARD, Failure, Missing, Trace, explain
from libero_env.sim.predicates import PREDICATES, contains, is_over, region_boxes, region_of
from libero_env.sim.scene import ROBOT
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

LIFTED = 0.02  # [m] above the height at the start
OVER = 0.30  # [m] above its place, an object is over it
_MOVED = 0.02  # [rad] or [m] that a joint of a fixture was moved
_LEFT, _RIGHT, _HAND, _ARM = "left finger", "right finger", "hand", "arm"


class EpisodeWatch:
    """Traces of the episodes of several simulations of one scene.

    Args:
        views: State view of each simulation.
        atoms: Atoms of the goal.

    Attributes:
        traces: What the present episode of each simulation has shown.
        wanted: Objects and fixtures that the goal is about.
    """

    def __init__(self, views: Sequence[StateView], atoms: Sequence[Atom]):
        self.views, self._scene, self.atoms = views, views[0].scene, tuple(atoms)
        scene, model = self._scene, self._scene.model
        self._names = [*scene.bodies, _LEFT, _RIGHT, _HAND, _ARM]
        self._codes = np.zeros(model.nbody, np.int64)  # of each body, the index of its name
        for code, bodies in enumerate(scene.bodies.values()):
            self._codes[bodies] = code
        first, second = (model.joint(name).bodyid[0] for name in FINGER_JOINTS)
        for body in scene.bodies[ROBOT]:
            part = _HAND if model.body(body).name.startswith("gripper0_") else _ARM
            part = _LEFT if first in _ancestors(model, body) else part
            part = _RIGHT if second in _ancestors(model, body) else part
            self._codes[body] = self._names.index(part)
        self.wanted = [name for atom in atoms if (name := scene.owner(atom.args[0]))]
        self._owned = {j: name for name in scene.entities for j in scene.joints[name]}
        self._joints = model.jnt_qposadr[list(self._owned)]
        self._scratch: mujoco.MjData | None = None
        self.traces = [Trace() for _ in views]
        self._heights: list[dict[str, float]] = [{} for _ in views]
        self._rest = np.zeros((len(views), len(self._joints)))
        self._widths = np.zeros(len(views))
        for i in range(len(views)):
            self.begin(i)

    def begin(self, i: int) -> None:
        """Begin the trace of an episode in the present state of simulation i."""
        view = self.views[i]
        self.traces[i] = Trace()
        self._heights[i] = {name: float(view.body_pos(name)[2]) for name in self._scene.objects}
        self._rest[i] = view.simulations.fields["qpos"][i, self._joints]

    def look(self, i: int) -> Trace:
        """Take note of the present state of simulation i, after a control step, and return its trace."""
        trace, view = self.traces[i], self.views[i]
        trace.steps += 1
        touching = self._touching(view.simulations.contact_geoms(i))
        trace.touching = {b for a, b in touching if a in (_LEFT, _RIGHT, _HAND)}
        trace.touched |= trace.touching
        width = float(np.abs(view.finger_pos).sum())
        if trace.in_hand is not None and not touching & {(_LEFT, trace.in_hand), (_RIGHT, trace.in_hand)}:
            if trace.in_hand in trace.lifted:
                trace.slipped[trace.in_hand] = width < float(
                    self._widths[i]
                )  # closed, for nothing is between
            trace.in_hand = None
        for name in self._scene.objects:
            if {(_LEFT, name), (_RIGHT, name)} <= touching:
                trace.in_hand, trace.held[name], self._widths[i] = name, trace.steps, width
                if view.body_pos(name)[2] > self._heights[i][name] + LIFTED:
                    trace.lifted[name] = None
                    trace.slipped.pop(name, None)
        if any(b not in self._scene.objects or a in (_HAND, _ARM) for a, b in touching):
            trace.impacts += [(trace.steps, what, force) for what, force in self._blows(i)]
        return trace

    def failure(self, i: int, ever: Sequence[bool], now: Sequence[bool]) -> Failure:
        """Return why the episode in simulation i has failed.

        Args:
            i: Index of the simulation.
            ever: Whether each atom of the goal held at any time.
            now: Whether each holds at the end.
        """
        trace, view = self.traces[i], self.views[i]
        missing = [
            Missing(name, bool(before), over(view, atom), self._place(i, name))
            for atom, before, holds in zip(self.atoms, ever, now, strict=True)
            if not holds and (name := self._scene.owner(atom.args[0]))
        ]
        found = explain(trace, missing, self.wanted)
        moved = np.abs(view.simulations.fields["qpos"][i, self._joints] - self._rest[i]) > _MOVED
        opened = [name for name, far in zip(self._owned.values(), moved, strict=True) if far]
        handled = tuple(dict.fromkeys([*trace.lifted, *(name for name in opened if name in trace.touched)]))
        instead = tuple(str(atom) for atom in self._possible(handled) if _holds(view, atom))
        return Failure(found.cause, found.of, found.what, round(found.newtons, 1), handled, instead)

    def _touching(self, geoms: np.ndarray) -> set[tuple[str, str]]:
        """Return the parts of the robot that touch something else, with what."""
        pairs = self._codes[self._scene.model.geom_bodyid[geoms]].reshape(-1, 2)
        robot = pairs >= len(self._names) - 4
        pairs = pairs[robot.any(axis=1) & ~robot.all(axis=1)]
        ordered = np.sort(pairs, axis=1)[:, ::-1]  # names of the robot's parts are last
        return {(self._names[a], self._names[b]) for a, b in set(map(tuple, ordered.tolist()))}

    def _blows(self, i: int) -> Iterator[tuple[str, float]]:
        """Yield what the robot hits, with the sum of the normal forces: of a solver that runs on a copy."""
        simulations, total = self.views[i].simulations, dict[str, float]()
        model, force = simulations.model, np.zeros(6)
        simulations.pose_fixtures(i)
        self._scratch = self._scratch or mujoco.MjData(model)
        mujoco.mj_copyData(self._scratch, model, simulations.data(i))
        mujoco.mj_forward(model, self._scratch)
        for k in range(self._scratch.ncon):
            for _, what in self._touching(self._scratch.contact.geom[k]):
                mujoco.mj_contactForce(model, self._scratch, k, force)
                total[what] = total.get(what, 0.0) + abs(float(force[0]))
        yield from ((what, newtons) for what, newtons in total.items() if newtons >= HARD)

    def _place(self, i: int, name: str) -> str:
        """Return what an object touches, rather something on the workspace than that; empty if nothing."""
        view, scene = self.views[i], self._scene
        there = [*(n for n in scene.entities if n != name), scene.workspace_name]
        return next((other for other in there if view.in_contact(name, other)), "")

    def _possible(self, handled: Sequence[str]) -> Iterator[Atom]:
        """Yield what a goal could say of the things that were handled, and the goal does not."""
        scene = self._scene
        regions = [region.address for region in scene.problem.regions if self._has_boxes(region.address)]
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
            yield from (atom for atom in candidates if atom not in self.atoms)

    def _has_boxes(self, address: str) -> bool:
        region = region_of(self.views[0], address)
        return (
            bool(region.ranges)
            or mujoco.mj_name2id(self._scene.model, mujoco.mjtObj.mjOBJ_SITE, address) >= 0
        )


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


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and all that it is part of."""
    found = set[int]()
    while body:
        found.add(int(body))
        body = model.body_parentid[body]
    return found
