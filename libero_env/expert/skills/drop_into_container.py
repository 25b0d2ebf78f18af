"""Dropping an object into an open container: the hand stays straight down, over the rim."""

from typing import Literal

import numpy as np

from libero_env.expert.arm.gripper import TIP_BELOW
from libero_env.expert.arm.servo import CLOSE, OPEN, action_toward, downward, finger_axis
from libero_env.expert.grasping.grasps import GraspError
from libero_env.expert.grasping.top_grasps import TopGrasp, choose_top_grasp
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom
from libero_env.timing import CONTROL_HZ

Phase = Literal["reach", "close", "carry", "release", "rest"]

ATTEMPTS, BACKINGS = 4, 3  # before it gives up
ARRIVED = (
    0.012  # m; wide, so that the moment to close is passed in motion and not approached for ever by a clone
)
ARRIVED_TURN = 0.12  # rad
STANDING, STILL = 0.008, 0.04  # m over where it should be, and slower than m/s: the hand stands on something
FINGER_CLEARANCE = 0.03  # m, of the fingertips over what they pass
AROUND = 0.08  # m, within which bodies count as in the way
OUT_OF_REACH = 0.005  # m, by which the arm may miss where it should take hold
HAND_OVER_RIM = 0.045  # m, of the grip site, so that the palm stays above a container


class DropIntoContainer:
    """Makes (In thing site) true where the site belongs to a container that can be moved, such as a basket.

    Shorter and surer than `PickPlace` for what it can do, and what it does is easy to clone. Phases: reach (down a
    funnel over the grasp), close, carry (up, over and a little down), release. An object that slipped, tipped or fell
    beside its place is taken again.

    Args:
        atom: what to make true.
        container: the object that the site belongs to.
        style: the manner.
        shapes: of the scene.

    Attributes:
        phase: what it is doing.
        retries: how often it had to start over.
        failure_reason: why it cannot go on, or ""; `PickPlace` may, which looks further for holds.
    """

    def __init__(self, atom: Atom, container: str, *, style: MotionStyle, shapes: Shapes):
        self.atom, self.container, self.style, self.shapes = atom, container, style, shapes
        self.thing, self.site = atom.args
        self.phase: Phase = "reach"
        self.retries = 0
        self.failure_reason = ""
        self._grasp: tuple[TopGrasp, Pose] | None = None  # and where the object was then
        self._rise = 0.0  # m, over the grasp, at which the fingertips pass over the object
        self._hold: tuple[np.ndarray, np.ndarray] | None = None  # pose to keep while the fingers move
        self._offset = np.zeros(3)  # of the object from the grip site when it was taken
        self._steps, self._opening = 0, 0.0
        self._pressed, self._backing = 0, False  # steps that something resisted the way down; going up again
        self._backings = 0  # times that the hand went up again
        self._before: np.ndarray | None = None  # where the grip site was one step ago
        self._velocity = np.zeros(3)

    @classmethod
    def container_of(cls, view: StateView, shapes: Shapes, atom: Atom) -> str | None:
        """The container, where this skill can do it: it is movable, and the object can be taken from above."""
        region = view.scene.problem.region(atom.args[-1])
        if (
            atom.predicate != "In"
            or region is None
            or region.ranges
            or region.target not in view.scene.objects
        ):
            return None
        try:
            pos, mat = cls(atom, region.target, style=MotionStyle(), shapes=shapes)._grasp_pose(view)
        except GraspError:
            return None
        angles = view.simulations.fields["qpos"][view.index][:7]
        _, miss = shapes.arm.follow(angles, [(pos + [0.0, 0.0, 0.1], mat), (pos, mat)])
        return region.target if miss < OUT_OF_REACH else None

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]: none while the fingers move."""
        return {"reach": 1.0, "carry": 0.7}.get(self.phase, 0.0)

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1]."""
        pos = view.eef_pos.copy()
        self._velocity = (pos - (pos if self._before is None else self._before)) * CONTROL_HZ
        self._before = pos
        return getattr(self, f"_{self.phase}")(view)

    def done(self, view: StateView) -> bool:
        """Whether the object lies in its place and the hand has let go."""
        return self.phase in ("reach", "rest") and self._holds(view)

    def _holds(self, view: StateView) -> bool:
        return evaluate(self.atom, view)

    def _enter(self, phase: Phase) -> None:
        self.phase, self._steps = phase, 0
        self._pressed, self._backing = 0, False

    def _again(self) -> None:
        self.retries += 1
        if self.retries > ATTEMPTS:
            self.failure_reason = f"{self.atom.args} not reached in {self.retries} attempts"
        self._grasp = None
        self._enter("reach")

    def _reach(self, view: StateView) -> np.ndarray:
        pos, style = view.eef_pos, self.style
        try:
            goal, mat = self._grasp_pose(view)
        except GraspError as error:
            self.failure_reason = str(error)
            return np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, OPEN])
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, mat)))
        self._steps += 1
        if away < ARRIVED and abs(goal[2] - pos[2]) < ARRIVED and turn < ARRIVED_TURN:
            self._hold = goal, mat
            self._enter("close")
            return self._close(view)
        lift = style.slope * (away - 0.008) + 0.3 * max(turn - ARRIVED_TURN, 0.0)
        lift = self._backed_off(away, goal[2], pos[2], np.clip(lift, 0.0, self._rise + style.hover))
        over = goal.copy()
        over[2] += lift
        if away > 0.05:
            way = self._in_the_way(view, goal, self.thing)
            over[2] = max(over[2], way + FINGER_CLEARANCE + TIP_BELOW)
        lateral = np.clip(1.0 - (over[2] - pos[2] - 0.02) / 0.04, 0.0, 1.0)
        return self._toward(view, over, mat, OPEN, lateral)

    def _backed_off(self, away: float, goal_height: float, height: float, lift: float) -> float:
        """The lift, or all of it while a finger that came to stand on something goes up and to the middle."""
        standing = height > goal_height + lift + STANDING and np.linalg.norm(self._velocity) < STILL
        self._pressed = self._pressed + 1 if standing and self._steps > 5 else 0
        if self._pressed >= 3 and not self._backing:
            self._backing, self._backings = True, self._backings + 1
            if self._backings > BACKINGS:
                self.failure_reason = f"something is in the way of taking {self.thing} from above"
        clear = height > goal_height + self._rise - TIP_BELOW + 0.01
        if away < 0.006 and clear:
            self._backing = False
        return self._rise + self.style.hover if self._backing else lift

    def _close(self, view: StateView) -> np.ndarray:
        opening = float(np.abs(view.finger_pos).sum())
        still = abs(opening - self._opening) < 4e-4
        self._opening = opening
        self._steps += 1
        if self._steps > 4 + self.style.pause and still or self._steps > 15:
            if opening < 0.004:
                self._again()
                return self._toward(view, view.eef_pos + [0, 0, 0.05], self._hold[1], OPEN)
            self._offset = view.body_pos(self.thing) - view.eef_pos
            self._enter("carry")
            return self._carry(view)
        return self._toward(view, *self._hold, CLOSE)

    def _carry(self, view: StateView) -> np.ndarray:
        pos, style = view.eef_pos, self.style
        offset = view.body_pos(self.thing) - pos
        if np.linalg.norm(offset - self._offset) > 0.03 + 0.3 * abs(self._offset[2]):
            self._again()
            return self._reach(view)
        hang = max(pos[2] - self.shapes.span(view, self.thing)[0], TIP_BELOW)
        rim = self.shapes.span(view, self.container)[1]
        goal = view.site_pos(self.site) - offset
        goal[:2] += style.place_xy
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        high = rim + hang + style.margin
        low = max(rim + hang - style.depth, rim + HAND_OVER_RIM)
        goal[2] = high if away > 0.03 else min(low, high)
        self._steps += 1
        if away < 0.025 and pos[2] < goal[2] + 0.02:
            self._hold = np.array([*goal[:2], min(goal[2], pos[2])]), self._hold[1]
            self._enter("release")
            return self._release(view)
        way = self._in_the_way(view, goal, self.thing) + hang + 0.7 * style.margin
        lateral = np.clip(1.0 - (min(way, high) - pos[2]) / 0.05, 0.0, 1.0)
        return self._toward(view, goal, self._hold[1], CLOSE, lateral)

    def _release(self, view: StateView) -> np.ndarray:
        self._steps += 1
        if self._steps <= self.style.pause:
            return self._toward(view, *self._hold, CLOSE)
        if self._steps > 14:
            if self._holds(view):
                self._enter("rest")
            else:
                self._again()
        return self._toward(view, *self._hold, OPEN)

    def _rest(self, view: StateView) -> np.ndarray:
        return np.array([0.0] * 6 + [OPEN])

    def _toward(
        self, view: StateView, goal: np.ndarray, mat: np.ndarray, gripper: float, lateral: float = 1.0
    ) -> np.ndarray:
        style = self.style
        return action_toward(
            view.eef_pos,
            view.eef_mat,
            goal,
            mat,
            velocity=self._velocity,
            gripper=gripper,
            gain=style.gain,
            speed=style.speed,
            lateral=lateral,
        )

    def _grasp_pose(self, view: StateView) -> tuple[np.ndarray, np.ndarray]:
        """Where the grip site must be to take the object, following it when it moves; planned anew when it turns."""
        now = pose_of(view, self.thing)
        if self._grasp is not None:
            then = self._grasp[1]
            moved = np.linalg.norm(now.pos - then.pos) > 0.01
            if moved or np.linalg.norm(rotation_between(then.mat, now.mat)) > 0.1:
                self._grasp = None
        if self._grasp is None:
            cloud, others = self.shapes.cloud(view, self.thing), self.shapes.others(view, self.thing)
            support = view.scene.workspace.surface_height
            grasp = choose_top_grasp(cloud, others, support, finger_axis(view.eef_mat), self.thing)
            self._grasp, self._rise = (grasp, now), cloud[:, 2].max() - grasp.pos_world[2] + TIP_BELOW
        grasp, then = self._grasp
        yaw = grasp.yaw + self.style.yaw
        along = np.array([-np.sin(grasp.yaw), np.cos(grasp.yaw), 0.0]) * self.style.grasp_along
        return grasp.pos_world + now.pos - then.pos + along, downward(yaw, finger_axis(view.eef_mat))

    def _in_the_way(self, view: StateView, goal: np.ndarray, thing: str) -> float:
        """Height of the highest thing near the next decimetre of the way, m."""
        others = self.shapes.others(view, thing)
        start = view.eef_pos[:2]
        way = goal[:2] - start
        length = float(np.linalg.norm(way))
        way = way * min(1.0, 0.10 / max(length, 1e-9))
        along = np.clip((others[:, :2] - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
        near = np.linalg.norm(others[:, :2] - start - along[:, None] * way, axis=1) < AROUND
        return float(others[near, 2].max(initial=view.scene.workspace.surface_height))
