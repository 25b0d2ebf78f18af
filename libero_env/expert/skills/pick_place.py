"""Picking an object and placing it where an atom of the goal requires it."""

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.arm import CLOSE, GRIPPER, OPEN, lateral_ramp
from libero_env.expert.clearance import hand_extent_below
from libero_env.expert.grasping.grasps import finger_offset
from libero_env.expert.grasping.kernels import open_hand_collision_depth
from libero_env.expert.planning.pick_plan import FailedAttempt
from libero_env.expert.planning.pick_planner import plan_pick, plan_place
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.expert.skills.skill import BackOff, Skill, funnel_lift, gripper_opening
from libero_env.expert.skills.transport import Move, Transport
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_about, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

MAX_REPLANS = 3  # of the place of what is in the hand
# wide, so that the fingers close in motion: a clone that creeps up to a threshold never passes it
ARRIVED, ARRIVED_TURN = 0.012, 0.12  # [m], [rad]
STANDING = 0.008  # [m] by which a hand that does not move is too high: a finger stands on something
FINGER_CLEARANCE = 0.03  # [m] of the fingertips over what they pass
OBSTACLE_RADIUS = 0.08  # [m] around the hand
# distance from the line of an approach, within which a hand joins it and beyond which it leaves it again: with one for
# both, a tilted hand that descends faster than the line does goes up and down for ever
ON_LINE = 0.05, 0.10  # [m]
LEVEL = 0.45  # vertical part of an approach, below which it counts as level
MAX_VERTICAL_SCALE = 0.05  # lateral scale up to which a hand rises without moving sideways
MAX_WAITING_STEPS = 25  # for an object to come to rest
PARTIAL_OPENING = 0.016  # [m] that the fingers open where there is no room for more
OPENED = 0.002  # [m] from which on the fingers are seen to open
SLOW = 0.35  # factor on the speed near a place
MAX_PHASE_STEPS = 130


class PickPlace(Skill):
    """Skill that makes an (On object place), (In object region) or (Stack object place) true.

    Phases: reach (down a funnel along the hand's approach), close, carry (up, over, and in along the place's entry),
    release, withdraw, rest. An object that slipped, tipped or fell beside its place is picked again.

    Args:
        atom: Atom to make true.
        slot: (k, n): the object is number k of n that go to the same place.
    """

    NOISE_SCALES = {"reach": 1.0, "close": 0.3, "carry": 0.7, "withdraw": 0.7}
    MAX_RETRIES = 6

    def __init__(self, atom: Atom, *, style: MotionStyle, shapes: Shapes, slot: tuple[int, int] = (0, 1)):
        super().__init__(atom, style)
        self.shapes, self.slot = shapes, slot
        self._object = atom.args[0]
        self._failures: list[FailedAttempt] = []
        self._clear_distance = 0.0  # [m] back along the approach, where the fingers are clear of the object
        self._hold_pose = Pose(np.zeros(3), np.eye(3))  # to keep while the fingers move
        self._finger_offset = np.zeros(3)  # [m] from the middle between the fingers to what they close on
        self._transport: Transport | None = None
        self._replans = 0
        self._opens_partially = False  # others are where the fingers would open to
        self._onward = np.zeros(3)  # way of the hand while the fingers begin to open, m
        self._closed_opening = 0.0  # [m] between the fingers when they began to
        self._back_off = BackOff()
        self._on_line = False  # of the approach; else the hand passes over obstacles to it
        self._stuck_steps = 0
        self._previous_turn = 0.0  # [rad] between hand and grasp one step ago
        self._rise_xy: np.ndarray | None = None  # where the hand rises before it moves sideways, (2,)
        self._previous_pose: Pose | None = None  # of the object one step ago
        self._waiting_steps = 0

    def _next_action(self, view: StateView) -> np.ndarray:
        if self.failure_reason or self.phase in ("reach", "rest") and not self._update_plan(view):
            return self._rise()
        if self._steps > MAX_PHASE_STEPS:
            self._hold_pose = Pose(view.eef_pos, view.eef_mat)
            self._enter("release")
        return self._run_phase(view)

    def _update_plan(self, view: StateView) -> bool:
        """Plan where there is no plan, or where the object moved by itself; return whether there is a plan."""
        pose = pose_of(view, self._object)
        if self._plan is not None and has_moved(self._plan.object_pose, pose):
            self._plan = None
        if self._plan is not None:
            return True
        previous, self._previous_pose = self._previous_pose, pose
        # as falling and rocking ones do
        moves = previous is not None and has_moved(previous, pose, 0.001, 0.015)
        if moves and self._waiting_steps < MAX_WAITING_STEPS:
            self._waiting_steps += 1
            return False
        self._waiting_steps = 0
        try:
            self._plan = plan_pick(view, self.shapes, self.atom, self.slot, self._failures)
        except LiberoError as error:
            self.failure_reason = str(error)
            return False
        grasp = self._plan.grasp
        height = (self.shapes.cloud(view, self._object) - grasp.pos_world) @ -grasp.mat[:, 2]
        self._clear_distance = float(height.max()) + GRIPPER.tip_below
        return True

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._back_off, self._on_line, self._stuck_steps = BackOff(), False, 0

    def _retry(self, placed: bool = False) -> None:
        """Begin again with another plan; `placed`: the object was released at its place."""
        if self._plan is not None:
            self._failures.append(FailedAttempt.from_plan(self._plan, placed))
        super()._retry()

    def _reach(self, view: StateView) -> np.ndarray:
        pos, style = view.eef_pos, self.style
        goal, mat = self._grasp_pose(view)
        back = -mat[:, 2]
        error = goal - pos
        lateral_error = float(np.linalg.norm(error - (error @ back) * back))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, mat)))
        if lateral_error < ARRIVED and abs(error @ back) < ARRIVED and turn < ARRIVED_TURN:
            self._hold_pose = Pose(goal, mat)
            self._finger_offset = finger_offset(self.shapes.cloud(view, self._object), goal, mat) * mat[:, 0]
            return self._start("close", view)
        still = np.linalg.norm(self._velocity) < 0.008 and abs(turn - self._previous_turn) < 0.01
        self._stuck_steps = self._stuck_steps + 1 if still and self._steps > 12 else 0
        self._previous_turn = turn
        if self._stuck_steps > 14 or self._back_off.count > 2:
            self._retry()
            return self._toward(view, pos + 0.08 * back, view.eef_mat, OPEN)
        height, full_lift = -float(error @ back), self._clear_distance + style.hover
        lift = funnel_lift(style.funnel_slope, lateral_error - 0.008, turn - ARRIVED_TURN, full_lift)
        self._back_off.update(
            standing=height > lift + STANDING and self._is_still() and self._steps > 5,
            clear=lateral_error < 0.006 and height > self._clear_distance - GRIPPER.tip_below + 0.01,
        )
        lift = full_lift if self._back_off.active else lift
        target, passing = self._approach_target(view, goal, back, lift, lateral_error)
        lateral_scale = 1.0
        if passing or back[2] > 0.9:
            lateral_scale = lateral_ramp(pos[2], target[2], 0.02, 0.04)
        return self._toward(view, target, mat, OPEN, lateral_scale)

    def _approach_target(
        self, view: StateView, goal: np.ndarray, back: np.ndarray, lift: float, lateral_error: float
    ) -> tuple[np.ndarray, bool]:
        """Return the next target on the way to a grasp, (3,), and whether the hand passes over obstacles.

        A tilted hand joins its approach above the obstacles; one that comes nearly level descends before the grasp.

        Args:
            goal: Position of the grip site at the grasp, (3,).
            back: Direction against the approach, (3,).
            lift: Distance back along the approach, [m].
            lateral_error: Distance from the line of the approach, [m].
        """
        target = goal + lift * back
        level = back[2] < LEVEL
        self._on_line = lateral_error < (ON_LINE[1] if self._on_line else ON_LINE[0])
        far = not level or float(np.linalg.norm((target - view.eef_pos)[:2])) > 0.03
        if self._on_line or not far:
            return target, False
        height = self.shapes.highest(view, self._object, (view.eef_pos, target, OBSTACLE_RADIUS))
        height = height + FINGER_CLEARANCE + hand_extent_below(view.eef_mat)
        if level:
            return np.array([*target[:2], max(target[2], height)]), True
        return target + max(height - target[2], 0.0) / back[2] * back, True

    def _close(self, view: StateView) -> np.ndarray:
        pose = self._hold_pose
        if self._fingers_stopped(view):
            if self._opening < 0.002:
                self._retry()
                return self._toward(view, view.eef_pos + [0, 0, 0.05], pose.mat, OPEN)
            self._transport, self._replans = None, 0
            return self._start("carry", view)
        # the finger that is near the object stays, and the other one comes
        offset = float(np.linalg.norm(self._finger_offset))
        closed = 0.5 * max(GRIPPER.max_opening - self._opening, 0.0)
        shift = self._finger_offset * min(1.0, closed / max(offset, 1e-9))
        return self._toward(view, pose.pos + shift, pose.mat, CLOSE)

    def _carry(self, view: StateView) -> np.ndarray:
        if self._transport is None:
            self._transport = self._make_transport(view)
        move = self._transport.next_move(view, self._velocity)
        if isinstance(move, Move):
            return self._toward(
                view, move.pos, move.mat, CLOSE, move.lateral_scale, SLOW if move.slow else 1.0
            )
        if move == "lost":
            self._retry()
            return self._toward(view, view.eef_pos, view.eef_mat, OPEN)
        if move != "arrived" and self._replan_place(view, self._transport, blocked=move == "blocked"):
            return self._toward(view, view.eef_pos, view.eef_mat, CLOSE)
        self._hold_pose = Pose(view.eef_pos, view.eef_mat)
        self._onward = self._transport.onward if move == "arrived" else np.zeros(3)
        return self._start("release", view)

    def _make_transport(self, view: StateView, exit_pose: Pose | None = None) -> Transport:
        plan, style, shapes = self._plan, self.style, self.shapes
        return Transport(view, self.atom, plan, style=style, shapes=shapes, exit_pose=exit_pose)

    def _replan_place(self, view: StateView, transport: Transport, blocked: bool) -> bool:
        """Choose another place for what is in the hand; return False without one, or after too many replans."""
        self._replans += 1
        if self._replans > MAX_REPLANS:
            return False
        if blocked:
            self._failures.append(FailedAttempt(None, self._plan.place))
        try:
            plan = plan_place(view, self.shapes, self.atom, self.slot, self._failures)
        except LiberoError:
            return False
        exit_pose = transport.exit_pose(view)
        self._plan, self._steps = plan, 0
        self._transport = self._make_transport(view, exit_pose)
        return True

    def _release(self, view: StateView) -> np.ndarray:
        pose = self._hold_pose
        if self._steps == 0:
            self._closed_opening = gripper_opening(view)
            obstacles = self.shapes.obstacles(view, self._object, spacing=DENSE)
            self._opens_partially = open_hand_collision_depth(obstacles, view.eef_pos, view.eef_mat) > 0.0
        if self._steps > 10:
            self._enter("withdraw")
        target, speed = pose.pos, 1.0
        if self._onward.any() and gripper_opening(view) < self._closed_opening + OPENED:
            target, speed = pose.pos + self._onward, SLOW
        return self._toward(view, target, pose.mat, self._gripper_opening_action(view), speed_scale=speed)

    def _gripper_opening_action(self, view: StateView) -> float:
        """Return the gripper's entry that opens it; where others are in the way, only as far as the object needs."""
        enough = gripper_opening(view) > self._opening + PARTIAL_OPENING
        return 0.0 if self._opens_partially and enough else OPEN

    def _withdraw(self, view: StateView) -> np.ndarray:
        pose = self._hold_pose
        back = -pose.mat[:, 2]
        away = float((view.eef_pos - pose.pos) @ back)
        if away > 0.07 or self._steps > 20:
            if evaluate(self.atom, view):
                self._enter("rest")
            else:
                self._retry(placed=True)
        gripper = OPEN if away > 0.05 else self._gripper_opening_action(view)
        return self._toward(view, pose.pos + 0.10 * back, pose.mat, gripper)

    def _steadied(self, view: StateView, pos: np.ndarray, lateral: float) -> tuple[np.ndarray, float]:
        """Keep a rising hand over its spot: one that rotates drifts."""
        if lateral > MAX_VERTICAL_SCALE or self._rise_xy is None:
            self._rise_xy = view.eef_pos[:2].copy()
            return pos, lateral
        return np.array([*self._rise_xy, pos[2]]), 1.0

    def _grasp_pose(self, view: StateView) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose (3,), (3, 3) of the grip site at the grasp, which follows small motions of the object."""
        grasp, start = self._plan.grasp, self._plan.object_pose
        shift = view.body_pos(self._object) - start.pos
        along = grasp.mat[:, 1] * self.style.grasp_shift
        mat = rotation_about(grasp.mat[:, 2], -self.style.yaw_error) @ grasp.mat
        return grasp.pos_world + shift + along, mat


def has_moved(before: Pose, now: Pose, distance: float = 0.01, angle: float = 0.1) -> bool:
    """Return whether a pose has changed by more than a distance, [m], or an angle, [rad]."""
    moved = np.linalg.norm(now.pos - before.pos) > distance
    return bool(moved or np.linalg.norm(rotation_between(before.mat, now.mat)) > angle)
