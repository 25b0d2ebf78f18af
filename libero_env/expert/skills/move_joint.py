"""Moving joints of fixtures: opening and closing drawers and doors, and turning knobs."""

import numpy as np

from libero_env.expert.arm import CLOSE, GRIPPER, OPEN, lateral_ramp
from libero_env.expert.clearance import obstacle_height
from libero_env.expert.grasping.grasps import GraspError
from libero_env.expert.grasping.handle_grasps import HandleGrasp, grasp_handle, grasp_knob
from libero_env.expert.grasping.handles import Part, find_handle, find_inner_side, is_knob, nearby_points
from libero_env.expert.skills.skill import Skill, funnel_lift
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate, state_bound
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom
from libero_env.timing import CONTROL_HZ

ARRIVED, ARRIVED_TURN = 0.008, 0.15  # [m], [rad] from where the fingers close
APPROACH = 0.08  # [m] from which the hand comes along its approach
OBSTACLE_RADIUS = 0.07  # [m] around the hand
# [m] of the target ahead of the hand that pushes a part, or pulls it: harder, it slips off slanting handles of drawers
PUSH_LEAD, PULL_LEAD = 0.06, 0.035
MAX_SLIP = 0.035  # [m] between hand and grasp
WITHDRAWN = 0.06  # [m] from the part, where the hand counts as withdrawn
AJAR, PULLED = 0.5, 0.85  # [rad] from which on a door is pushed open, and up to which it is pulled
MAX_KNOB_LEAD, MIN_KNOB_LEAD = 0.45, -0.15  # [rad] of the hand ahead of a knob
KNOB_SPEED_GAIN, KNOB_STOP_SPEED = 2.0, 0.05  # [1/s], [rad/s] of a knob before its stop
MAX_KNOB_SPEED = 0.9  # [rad/s]
MAX_PHASE_STEPS, MAX_MOVE_STEPS = 90, 180  # of one phase, and of moving the part


class MoveJoint(Skill):
    """Skill that brings the joints of a fixture, or of one of its parts, into a state.

    To open, the hand grasps the handle and pulls; to close, closed fingers push; a knob is grasped from above and
    turned. The hand withdraws when the state holds with a margin, and begins again after a slip.
    Phases: reach, close, move, release, withdraw, rest.

    Args:
        address: Name of a fixture, or address of a region that belongs to its part.
        state: State of the joint, by the names of `ObjectModel.articulation`.
        style: Motion style; the default one if None.
    """

    NOISE_SCALES = {"reach": 1.0, "close": 0.3, "withdraw": 0.7, "move": 0.4}

    def __init__(self, address: str, state: str, *, style: MotionStyle | None = None):
        super().__init__(Atom(state.capitalize(), (address,)), style or MotionStyle())
        self.address, self.state = address, state
        self._part: Part
        self._grasp: HandleGrasp  # in the frame of the part
        self._failed: list[Pose] = []  # pre-grasps of earlier attempts
        self._obstacles = np.zeros((0, 3))
        self._still_steps = 0
        # positions of the joint, [m] or [rad]
        self._start_value, self._previous_value, self._target_value = 0.0, 0.0, 0.0
        self._pulled = False  # a door, as far as it is pulled by its handle
        self._release_pose = Pose(np.zeros(3), np.eye(3))  # where the hand let go

    def done(self, view: StateView) -> bool:
        """Return whether the state holds with a margin and the hand is away."""
        return self._is_reached(view) and (self._plan is None or self.phase == "rest")

    def _next_action(self, view: StateView) -> np.ndarray:
        if self.failure_reason or self.phase == "rest" and self._is_reached(view):
            return self._rest(view)
        if self.phase == "rest":
            self._retry()
        if self._plan is None and not self._make_plan(view):
            return self._rest(view)
        if self._steps > (MAX_MOVE_STEPS if self.phase == "move" else MAX_PHASE_STEPS):
            return self._start("release", view)  # withdraw, and begin again
        return self._run_phase(view)

    def _make_plan(self, view: StateView) -> bool:
        """Choose the joint and the grasp; return False where nothing is left to do or nothing can be grasped."""
        model = view.scene.model
        parts = [Part.from_joint(model, joint) for joint in view.scene.joints.get(self.address, ())]
        if not parts:
            self.failure_reason = f"{self.address} has no joint to {self.state}"
            return False
        gaps = [abs(self._goal_value(view, part) - part.value(view)) for part in parts]
        # one joint is enough to open, all have to be closed
        choose = np.argmin if self.state in ("open", "turnon") else np.argmax
        part = parts[int(choose(gaps))]
        if self._is_reached(view):
            self._enter("rest")
            return False
        value, self._target_value = part.value(view), self._goal_value(view, part)
        try:
            grasp = self._find_grasp(view, part, value)
        except GraspError as error:
            self.failure_reason = str(error)
            return False
        self._part = part
        self._plan = self._grasp = grasp.relative_to(part.pose(view))
        self._obstacles = nearby_points(view, grasp.contact.pos, view.scene.entities)
        self._start_value = value
        self._failed.append(grasp.pregrasp)
        self._pulled = False
        self._enter("reach")
        return True

    def _find_grasp(self, view: StateView, part: Part, value: float) -> HandleGrasp:
        """Return the grasp of a part, whose joint is at `value`, that moves it towards the target value.

        Raises:
            GraspError: The part cannot be grasped.
        """
        left = self._target_value - value
        direction = float(np.sign(left))
        if is_knob(view, part):
            return grasp_knob(view, part, left)
        if self.state in ("close", "turnoff"):
            return grasp_handle(view, part, find_handle(view, part, -direction), left, False, self._failed)
        closed = float(view.scene.model.jnt_range[part.joint][0 if direction > 0 else 1])
        if not part.slides and abs(value - closed) >= AJAR:
            return grasp_handle(view, part, find_inner_side(view, part, direction), left, False, self._failed)
        if not part.slides:
            self._target_value = value + direction * min(PULLED, abs(left))
        left = self._target_value - value
        return grasp_handle(view, part, find_handle(view, part, direction), left, True, self._failed)

    def _limits(self, view: StateView) -> tuple[float, float, float, float]:
        """Return (threshold, end, width, direction) of the state, [m] or [rad]."""
        owner = view.scene.owner(self.address)
        assert owner is not None
        model = view.scene.entities[owner]
        low, high = sorted(model.articulation[self.state])
        _, upwards = state_bound(model, self.state)
        return (low, high, high - low, 1.0) if upwards else (high, low, high - low, -1.0)

    def _goal_value(self, view: StateView, part: Part) -> float:
        """Return the position to which a joint is moved: well into the state, or against its stop."""
        threshold, end, width, direction = self._limits(view)
        if self.state in ("open", "turnon"):
            return threshold + direction * min(0.6 * width, 0.25)
        if self.state == "turnoff":
            return end + direction * 0.02
        stop = view.scene.model.jnt_range[part.joint][1 if direction > 0 else 0]
        return float(max(end, stop) if direction > 0 else min(end, stop))

    def _is_reached(self, view: StateView) -> bool:
        """Return whether the state holds with a margin."""
        if not evaluate(self.atom, view):
            return False
        if self.state in ("close", "turnoff"):
            return True
        threshold, _, width, direction = self._limits(view)
        values = view.joint_positions(self.address).values()
        return any(direction * (value - threshold) > min(0.15 * width, 0.12) for value in values)

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._still_steps = 0

    def _reach(self, view: StateView) -> np.ndarray:
        pos, frame = view.eef_pos, self._part.pose(view)
        goal, back = frame.to_world(self._grasp.pregrasp), frame.mat @ self._grasp.retreat
        error = goal.pos - pos
        lateral_error = float(np.linalg.norm(error - (error @ back) * back))
        away = float(np.linalg.norm(error))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, goal.mat)))
        still = np.linalg.norm(self._velocity) < 0.01 and self._steps > 5
        self._still_steps = self._still_steps + 1 if still else 0
        touching = self._still_steps > 4 and away < 0.025 and turn < 2 * ARRIVED_TURN
        if away < ARRIVED and turn < ARRIVED_TURN or touching:
            return self._start("close" if self._grasp.gripping else "move", view)
        if self._still_steps > 8:
            return self._start("release", view)
        lift = funnel_lift(self.style.funnel_slope, lateral_error - 0.006, turn - ARRIVED_TURN, APPROACH)
        target = goal.pos + lift * back
        lateral_scale = 1.0
        if np.linalg.norm((target - pos)[:2]) > 0.08:
            surface = view.scene.workspace.surface_height
            height = obstacle_height(self._obstacles, pos, target, OBSTACLE_RADIUS, surface)
            target[2] = max(target[2], height + 0.04 + GRIPPER.tip_below)
            lateral_scale = lateral_ramp(pos[2], target[2], 0.03, 0.05)
        return self._toward(view, target, goal.mat, OPEN if self._grasp.gripping else CLOSE, lateral_scale)

    def _close(self, view: StateView) -> np.ndarray:
        if self._fingers_stopped(view, max_steps=16):
            if self._opening < 0.004:
                return self._start("release", view)
            self._previous_value = self._part.value(view)
            return self._start("move", view)
        goal = self._part.pose(view).to_world(self._grasp.contact)
        return self._toward(view, goal.pos, goal.mat, CLOSE)

    def _move(self, view: StateView) -> np.ndarray:
        part, grasp, value = self._part, self._grasp, self._part.value(view)
        left = self._target_value - value
        contact = part.pose(view).to_world(grasp.contact)
        anchor, axis = part.axis(view)
        distance = float(np.linalg.norm(np.cross(contact.pos - anchor, axis)))
        radius = 1.0 if part.slides else max(distance, 0.03)
        speed = np.sign(left) * (value - self._previous_value) * CONTROL_HZ
        self._previous_value = value
        slow = abs(speed) * max(radius, 0.2) < 0.01
        self._still_steps = self._still_steps + 1 if slow and self._steps > 5 else 0
        is_pulled_door = self.state == "open" and not self._part.slides and self._grasp.gripping
        fully_pulled = is_pulled_door and abs(left) < 0.05  # it is pushed the rest of the way
        finished = self._is_reached(view) and self._is_settled(left, speed, slow)
        if finished or fully_pulled or self._still_steps > 30:
            self._pulled = fully_pulled
            return self._start("release", view)
        if grasp.gripping and np.linalg.norm(view.eef_pos - contact.pos) > MAX_SLIP:
            return self._start("release", view)
        lead = min((PULL_LEAD if grasp.gripping else PUSH_LEAD) / radius, 0.5)
        ahead = np.sign(left) * min(abs(left) + 0.5 * lead, lead)  # beyond the target, as the hand gives way
        if self.state == "turnoff":
            ahead = np.sign(left) * self._knob_lead(left, speed)
        moved = value + ahead - self._start_value
        start = part.pose_after(view, contact, self._start_value - value)
        goal = part.pose_after(view, start, moved, rotation=grasp.follow_ratio * moved)
        return self._toward(view, goal.pos, goal.mat, CLOSE)

    def _is_settled(self, left: float, speed: float, slow: bool) -> bool:
        """Return whether the joint stays where it is: near its target, or slow where it has a stop.

        Args:
            left: Distance to the target value, [m] or [rad].
            speed: Speed towards it, per second.
            slow: Whether the hand hardly moves.
        """
        if self.state in ("open", "turnon"):
            return abs(left) < (0.003 if self._part.slides else 0.05) or self._still_steps > 3
        return abs(speed) < 0.004 if self.state == "turnoff" else slow

    def _knob_lead(self, left: float, speed: float) -> float:
        """Return how far the hand is ahead of a heavy knob, [rad], so that it reaches its stop slowly and stays there.

        Args:
            left: Angle to the stop, [rad].
            speed: Speed towards it, [rad/s].
        """
        target_speed = min(KNOB_SPEED_GAIN * abs(left) + KNOB_STOP_SPEED, MAX_KNOB_SPEED)
        lead = 0.6 * target_speed + target_speed - speed
        return float(np.clip(lead, MIN_KNOB_LEAD, MAX_KNOB_LEAD))

    def _release(self, view: StateView) -> np.ndarray:
        if self._steps <= 1:
            self._release_pose = Pose(view.eef_pos, view.eef_mat)
        if not self._grasp.gripping or self._steps > 9:
            return self._start("withdraw", view)
        return self._toward(view, self._release_pose.pos, self._release_pose.mat, OPEN)

    def _withdraw(self, view: StateView) -> np.ndarray:
        start, back = self._release_pose, self._part.pose(view).mat @ self._grasp.retreat
        if (view.eef_pos - start.pos) @ back > WITHDRAWN or self._steps > 25:
            self._enter("rest")
            if not self._is_reached(view):
                self._retry()
                self.retries -= self._pulled
            return self._rest(view)
        gripper = OPEN if self._grasp.gripping else CLOSE
        return self._toward(view, start.pos + (WITHDRAWN + 0.05) * back, start.mat, gripper)
