"""Opening, closing and turning what a joint moves: drawers, doors and knobs."""

from typing import Literal

import numpy as np

from libero_env.expert.arm.gripper import TIP_BELOW
from libero_env.expert.arm.servo import CLOSE, OPEN, action_toward
from libero_env.expert.grasping.grasps import GraspError
from libero_env.expert.grasping.handle_grasps import Hold, handle_hold, knob_hold
from libero_env.expert.grasping.handles import Part, find_handle, inner_side, is_knob, surroundings
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom
from libero_env.timing import CONTROL_HZ

State = Literal["open", "close", "turnon", "turnoff"]
Phase = Literal["reach", "close", "move", "release", "withdraw", "rest"]

ATTEMPTS = 5
ARRIVED, ARRIVED_TURN = 0.008, 0.15  # m and rad, to where the fingers close
BACK = 0.08  # m, that the hand comes from along its approach
LEAD = 0.06  # m, of the goal ahead of the hand while it moves the part
SLIPPED = 0.035  # m, between the hand and the hold
AWAY = 0.06  # m, from the handle, where the hand counts as withdrawn
AROUND = 0.07  # m, within which things count as in the way
AJAR, PULLED = 0.5, 0.85  # rad; a door is drawn until it is that far open, and beyond AJAR pushed
KNOB = 0.45  # rad, of the hand ahead of a knob, at most
BRAKE = 2.0, 0.05  # 1/s and rad/s: speed of a knob before its stop by what is left, and when it gets there
STUCK, STUCK_MOVING = 90, 180  # steps of one phase, and of moving the part


class MoveJoint:
    """Brings the joints of a fixture, or of one of its parts, into a state.

    To open, it takes the handle and draws; to close, it pushes with closed fingers; a knob is taken from above and
    turned. The hand withdraws when the state holds with a margin, and begins again after a slip.

    Args:
        address: fixture, or region of its part.
        state: of the joint, by the names of `ObjectModel.articulation`.
        style: the manner.

    Attributes:
        phase: what it is doing.
        retries: how often it had to begin again.
        failure_reason: why it cannot go on, or "".
    """

    def __init__(self, address: str, state: State, *, style: MotionStyle | None = None):
        self.address, self.state = address, state
        self.style = style or MotionStyle()
        self.phase: Phase = "reach"
        self.retries, self.failure_reason = 0, ""
        self._part: Part | None = None
        self._hold: Hold | None = None  # in the frame of the part
        self._around = np.zeros((0, 3))
        self._before: np.ndarray | None = None
        self._velocity = np.zeros(3)
        self._steps, self._still = 0, 0
        self._opening, self._begun, self._value, self._aim = 0.0, 0.0, 0.0, 0.0  # m; m or rad, of the joint
        self._drawn = False  # a door, as far as by its handle
        self._left: Pose | None = None  # where the hand let go
        self._failed: list[Pose] = []  # holds of earlier attempts

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]."""
        return {"reach": 1.0, "withdraw": 0.7, "move": 0.4}.get(self.phase, 0.0)

    def done(self, view: StateView) -> bool:
        """Whether the state holds with a margin and the hand is away."""
        return self._moved(view) and (self._hold is None or self.phase == "rest")

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1]."""
        pos = view.eef_pos
        self._velocity = (pos - (pos if self._before is None else self._before)) * CONTROL_HZ
        self._before = pos
        self._steps += 1
        if self.failure_reason or self.phase == "rest" and self._moved(view):
            return self._stay()
        if self.phase == "rest":
            self._again()
        if self._hold is None and not self._plan(view):
            return self._stay()
        if self._steps > (STUCK_MOVING if self.phase == "move" else STUCK):
            return self._retreat(view)
        return getattr(self, f"_{self.phase}")(view)

    def _plan(self, view: StateView) -> bool:
        """Choose the joint and the hold; False where nothing is to do or to take."""
        model = view.scene.model
        parts = [Part.of(model, joint) for joint in view.scene.joints.get(self.address, ())]
        if not parts:
            self.failure_reason = f"{self.address} has no joint to {self.state}"
            return False
        gaps = [abs(self._goal(view, part) - part.value(view)) for part in parts]
        # one joint is enough to open, all have to be closed
        choose = np.argmin if self.state in ("open", "turnon") else np.argmax
        part = parts[int(choose(gaps))]
        if self._moved(view):
            self._enter("rest")
            return False
        value, self._aim = part.value(view), self._goal(view, part)
        way = float(np.sign(self._aim - value))
        try:
            if is_knob(view, part):
                hold = knob_hold(view, part, self._aim - value)
            elif self.state in ("close", "turnoff"):
                handle = find_handle(view, part, -way)
                hold = handle_hold(view, part, handle, self._aim - value, False, self._failed)
            elif part.slides or abs(value - self._shut(view, part, way)) < AJAR:
                if not part.slides:
                    self._aim = value + way * min(PULLED, abs(self._aim - value))
                handle = find_handle(view, part, way)
                hold = handle_hold(view, part, handle, self._aim - value, True, self._failed)
            else:
                hold = handle_hold(
                    view, part, inner_side(view, part, way), self._aim - value, False, self._failed
                )
        except GraspError as error:
            self.failure_reason = str(error)
            return False
        self._part = part
        self._around = surroundings(view, -1, hold.held.pos, view.scene.entities)
        self._hold = hold.within(part.pose(view))
        self._begun = value
        self._failed.append(hold.ready)
        self._drawn = False
        self._enter("reach")
        return True

    def _limits(self, view: StateView) -> tuple[float, float, float, float]:
        """(threshold, end, margin, upwards) of the state, m or rad."""
        owner = view.scene.owner(self.address)
        ranges = view.scene.entities[owner].articulation
        low, high = sorted(ranges[self.state])
        opposite = {"open": "close", "close": "open", "turnon": "turnoff", "turnoff": "turnon"}[self.state]
        upwards = opposite not in ranges or low + high > sum(ranges[opposite])
        return (low, high, high - low, 1.0) if upwards else (high, low, high - low, -1.0)

    def _goal(self, view: StateView, part: Part) -> float:
        """Where the joint is brought: well into the state, or against its stop."""
        threshold, end, width, way = self._limits(view)
        if self.state in ("open", "turnon"):
            return threshold + way * min(0.6 * width, 0.25)
        if self.state == "turnoff":
            return end + way * 0.02
        stop = view.scene.model.jnt_range[part.joint][1 if way > 0 else 0]
        return float(max(end, stop) if way > 0 else min(end, stop))

    def _shut(self, view: StateView, part: Part, way: float) -> float:
        """Where the joint is when it is closed, by the range that it is moved away from."""
        return float(view.scene.model.jnt_range[part.joint][0 if way > 0 else 1])

    def _moved(self, view: StateView) -> bool:
        """Whether the predicate holds with a margin."""
        name = self.state.capitalize()
        if not evaluate(Atom(name, (self.address,)), view):
            return False
        if self.state in ("close", "turnoff"):
            return True
        threshold, _, width, way = self._limits(view)
        values = view.joint_positions(self.address).values()
        return any(way * (value - threshold) > min(0.15 * width, 0.12) for value in values)

    def _enter(self, phase: Phase) -> None:
        self.phase, self._steps, self._still = phase, 0, 0

    def _again(self) -> None:
        self.retries += 1
        self._hold = None
        if self.retries > ATTEMPTS:
            self.failure_reason = f"{self.address} did not get to {self.state} in {self.retries} attempts"
        self._enter("reach")

    def _reach(self, view: StateView) -> np.ndarray:
        frame = self._part.pose(view)
        goal, way = _placed(frame, self._hold.ready), frame.mat @ self._hold.back
        error = goal.pos - view.eef_pos
        aside = float(np.linalg.norm(error - (error @ way) * way))
        away = float(np.linalg.norm(error))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, goal.mat)))
        self._still = self._still + 1 if np.linalg.norm(self._velocity) < 0.01 and self._steps > 5 else 0
        touching = self._still > 4 and away < 0.025 and turn < 2 * ARRIVED_TURN
        if away < ARRIVED and turn < ARRIVED_TURN or touching:
            self._enter("close" if self._hold.grips else "move")
            return getattr(self, f"_{self.phase}")(view)
        if self._still > 8:
            return self._retreat(view)
        back = np.clip(self.style.slope * (aside - 0.006) + 0.3 * max(turn - ARRIVED_TURN, 0.0), 0.0, BACK)
        target = goal.pos + back * way
        flat = float(np.linalg.norm((target - view.eef_pos)[:2]))
        lateral = 1.0
        if flat > 0.08:
            target[2] = max(target[2], self._in_the_way(view, target) + 0.04 + TIP_BELOW)
            lateral = np.clip(1.0 - (target[2] - view.eef_pos[2] - 0.03) / 0.05, 0.0, 1.0)
        return self._toward(view, target, goal.mat, OPEN if self._hold.grips else CLOSE, lateral)

    def _close(self, view: StateView) -> np.ndarray:
        goal = _placed(self._part.pose(view), self._hold.held)
        opening = float(np.abs(view.finger_pos).sum())
        still = abs(opening - self._opening) < 4e-4
        self._opening = opening
        if self._steps > 4 + self.style.pause and still or self._steps > 16:
            if opening < 0.004:
                return self._retreat(view)
            self._value = self._part.value(view)
            self._enter("move")
            return self._move(view)
        return self._toward(view, goal.pos, goal.mat, CLOSE)

    def _move(self, view: StateView) -> np.ndarray:
        part, value = self._part, self._part.value(view)
        left = self._aim - value
        hold = _placed(part.pose(view), self._hold.held)
        anchor, axis = part.axis(view)
        arm = 1.0 if part.slides else max(float(np.linalg.norm(np.cross(hold.pos - anchor, axis))), 0.03)
        speed = np.sign(left) * (value - self._value) * CONTROL_HZ
        slow = abs(speed) * max(arm, 0.2) < 0.01
        self._value = value
        self._still = self._still + 1 if slow and self._steps > 5 else 0
        settled = slow
        if self.state in ("open", "turnon"):
            settled = abs(left) < (0.003 if part.slides else 0.05) or self._still > 3
        if self.state == "turnoff":
            settled = abs(speed) < 0.004
        if self._moved(view) and settled or self._still > 30 or self._stage(left):
            self._drawn = self._stage(left)
            self._enter("release")
            return self._release(view)
        if self._hold.grips and np.linalg.norm(view.eef_pos - hold.pos) > SLIPPED:
            return self._retreat(view)
        lead = min(LEAD / arm, 0.5)
        ahead = np.sign(left) * min(abs(left) + 0.5 * lead, lead)  # beyond it, as the hand gives way
        if self.state == "turnoff":
            ahead = np.sign(left) * self._brake(left, speed)
        then = value + ahead - self._begun
        begun = part.moved(view, hold, self._begun - value)
        goal = part.moved(view, begun, then, turn=self._hold.follow * then)
        return self._toward(view, goal.pos, goal.mat, CLOSE)

    def _brake(self, left: float, speed: float) -> float:
        """How far the hand is ahead of a heavy knob, rad, so that it comes to its stop slowly and stays there."""
        wanted = min(BRAKE[0] * abs(left) + BRAKE[1], 0.9)
        return float(np.clip(0.6 * wanted + wanted - speed, -0.15, KNOB))

    def _stage(self, left: float) -> bool:
        """Whether a door is as far open as it is drawn; the rest of the way it is pushed."""
        return self.state == "open" and not self._part.slides and self._hold.grips and abs(left) < 0.05

    def _release(self, view: StateView) -> np.ndarray:
        if self._left is None or self._steps <= 1:
            self._left = Pose(view.eef_pos, view.eef_mat)
        if not self._hold.grips or self._steps > 9:
            self._enter("withdraw")
            return self._withdraw(view)
        return self._toward(view, self._left.pos, self._left.mat, OPEN)

    def _withdraw(self, view: StateView) -> np.ndarray:
        left, back = self._left, self._part.pose(view).mat @ self._hold.back
        if (view.eef_pos - left.pos) @ back > AWAY or self._steps > 25:
            self._enter("rest")
            if not self._moved(view):
                self._again()
                self.retries -= self._drawn
            return self._stay()
        return self._toward(
            view, left.pos + (AWAY + 0.05) * back, left.mat, OPEN if self._hold.grips else CLOSE
        )

    def _retreat(self, view: StateView) -> np.ndarray:
        """Let go, withdraw, and begin again."""
        self._enter("release")
        self._left = None
        return self._release(view)

    def _rest(self, view: StateView) -> np.ndarray:
        return self._stay()

    def _stay(self) -> np.ndarray:
        return np.array([0.0] * 6 + [OPEN])

    def _toward(
        self, view: StateView, pos: np.ndarray, mat: np.ndarray, gripper: float, lateral: float = 1.0
    ) -> np.ndarray:
        style = self.style
        return action_toward(
            view.eef_pos,
            view.eef_mat,
            pos,
            mat,
            velocity=self._velocity,
            gripper=gripper,
            gain=style.gain,
            speed=style.speed,
            lateral=lateral,
        )

    def _in_the_way(self, view: StateView, goal: np.ndarray) -> float:
        """Height of the highest thing near the next decimetre of the way, m."""
        start = view.eef_pos[:2]
        way = goal[:2] - start
        way = way * min(1.0, 0.10 / max(float(np.linalg.norm(way)), 1e-9))
        offset = self._around[:, :2] - start
        along = np.clip(offset @ way / max(way @ way, 1e-12), 0.0, 1.0)
        near = np.linalg.norm(offset - along[:, None] * way, axis=1) < AROUND
        return float(self._around[near, 2].max(initial=view.scene.workspace.surface_height))


def _placed(frame: Pose, pose: Pose) -> Pose:
    """A pose of a frame in the world."""
    return Pose(frame.mat @ pose.pos + frame.pos, frame.mat @ pose.mat)
