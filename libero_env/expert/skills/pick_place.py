"""Taking an object and putting it where an atom of the goal wants it."""

from typing import Literal

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.arm.gripper import MAX_OPENING, TIP_BELOW
from libero_env.expert.arm.servo import CLOSE, OPEN, action_toward
from libero_env.expert.clearance import lowest, obstacle_height
from libero_env.expert.grasping.costs import finger_offset
from libero_env.expert.grasping.grasps import crowding
from libero_env.expert.planning.pick_plan import Approach, Failure, choose_approach, choose_place
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.expert.skills.transport import Carry, Move
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom
from libero_env.timing import CONTROL_HZ

Phase = Literal["reach", "close", "carry", "release", "withdraw", "rest"]

ATTEMPTS = 6
ARRIVED = (
    0.012  # m; wide, so that the moment to close is passed in motion and not approached for ever by a clone
)
ARRIVED_TURN = 0.12  # rad
STANDING, STILL = 0.008, 0.04  # m over where it should be, and slower than m/s: the hand stands on something
FINGER_CLEARANCE = 0.03  # m, of the fingertips over what they pass
LEVEL = 0.45  # vertical part of an approach below which it counts as level
AROUND = 0.08  # m, within which bodies count as in the way
DIVERTED = 3  # times that another place is chosen for what is in the hand
RISING = 0.05  # share of the way sideways up to which a hand stays where it is
PATIENCE = 25  # steps, to wait for an object to come to rest
EASE = 0.016  # m, that the fingers open where there is no room for more
STUCK = 130  # steps of one phase


class PickPlace:
    """Makes an (On thing place) or (In thing place) true.

    It moves in phases: reach (down a funnel along the hand's approach), close, carry (up, over, and in along the
    place's entry), release, withdraw. An object that slipped, tipped or fell beside its place is taken again.

    Args:
        atom: what shall hold.
        style: the manner.
        shapes: of the scene.
        share: which of how many things that go to the same place.

    Attributes:
        phase: what it is doing.
        retries: how often it had to begin again.
        failure_reason: why it cannot go on, or "".
    """

    def __init__(self, atom: Atom, *, style: MotionStyle, shapes: Shapes, share: tuple[int, int] = (0, 1)):
        self.atom, self.style, self.shapes, self.share = atom, style, shapes, share
        self.phase: Phase = "reach"
        self.retries, self.failure_reason = 0, ""
        self._thing = atom.args[0]
        self._way: Approach | None = None
        self._rise = 0.0  # m, back along the approach, where the fingers are clear of the object
        self._hold: Pose | None = None  # pose to keep while the fingers move
        self._carrying: Carry | None = None
        self._diverted = 0  # times that another place was chosen on the way
        self._aside = np.zeros(3)  # m, from the middle between the fingers to that of what they close on
        self._steps, self._opening = 0, 0.0
        self._tight = False  # others are where the fingers would open to
        self._pressed, self._backing = 0, False  # steps that something resisted the way in; going back out
        self._stuck, self._backings = 0, 0  # steps without motion, and times it backed off
        self._turn = 0.0  # rad, that the hand was from its hold one step ago
        self._failures: list[Failure] = []
        self._before: np.ndarray | None = None  # where the grip site was one step ago
        self._velocity = np.zeros(3)
        self._anchor: np.ndarray | None = None  # (2,) where the hand rises, before it moves sideways
        self._lay: Pose | None = None  # the object's pose one step ago
        self._waited = 0  # steps, for the object to come to rest

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]: none while the fingers move."""
        return {"reach": 1.0, "carry": 0.7, "withdraw": 0.7}.get(self.phase, 0.0)

    def done(self, view: StateView) -> bool:
        """Whether the atom holds and the hand is away from the object."""
        return self.phase in ("reach", "rest") and evaluate(self.atom, view)

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1]."""
        pos = view.eef_pos
        self._velocity = (pos - (pos if self._before is None else self._before)) * CONTROL_HZ
        self._before = pos
        self._steps += 1
        if self.failure_reason or self.phase in ("reach", "rest") and not self._plan(view):
            return np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, OPEN])
        if self._steps > STUCK:
            self._hold = Pose(pos, view.eef_mat)
            self._enter("release")
        return getattr(self, f"_{self.phase}")(view)

    def _plan(self, view: StateView) -> bool:
        """Choose hold and place, again when the object moved by itself; False where there are none."""
        now = pose_of(view, self._thing)
        if self._way is not None:
            then = self._way.pose
            moved = np.linalg.norm(now.pos - then.pos) > 0.01
            if moved or np.linalg.norm(rotation_between(then.mat, now.mat)) > 0.1:
                self._way = None
        if self._way is None:
            if self._moving(now) and self._waited < PATIENCE:
                self._waited += 1
                return False
            self._waited = 0
            try:
                self._way = choose_approach(view, self.shapes, self.atom, self.share, self._failures)
            except LiberoError as error:
                self.failure_reason = str(error)
                return False
            grasp = self._way.grasp
            depth = (self.shapes.cloud(view, self._thing) - grasp.pos_world) @ -grasp.mat[:, 2]
            self._rise = float(depth.max()) + TIP_BELOW
        return True

    def _moving(self, now: Pose) -> bool:
        """Whether the object has moved since the last step; falling and rocking things are not planned for."""
        before, self._lay = self._lay, now
        if before is None:
            return False
        turn = np.linalg.norm(rotation_between(before.mat, now.mat))
        return bool(np.linalg.norm(now.pos - before.pos) > 0.001 or turn > 0.015)

    def _enter(self, phase: Phase) -> None:
        self.phase, self._steps = phase, 0
        self._pressed, self._backing = 0, False
        self._stuck, self._backings = 0, 0

    def _again(self, placed: bool = False) -> None:
        """Begin again, another way; `placed`: the object was let go of at its place."""
        if self._way is not None:
            self._failures.append(Failure.of(self._way, placed))
        self.retries += 1
        self._way = None
        if self.retries > ATTEMPTS:
            self.failure_reason = f"{self.atom.args} not reached in {self.retries} attempts"
        self._enter("reach")

    def _reach(self, view: StateView) -> np.ndarray:
        pos, style = view.eef_pos, self.style
        goal, mat = self._grasp_pose(view)
        back = -mat[:, 2]
        error = goal - pos
        aside = float(np.linalg.norm(error - (error @ back) * back))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, mat)))
        if aside < ARRIVED and abs(error @ back) < ARRIVED and turn < ARRIVED_TURN:
            self._hold = Pose(goal, mat)
            self._aside = finger_offset(self.shapes.cloud(view, self._thing), goal, mat) * mat[:, 0]
            self._enter("close")
            return self._close(view)
        still = np.linalg.norm(self._velocity) < 0.008 and abs(turn - self._turn) < 0.01
        self._stuck, self._turn = (self._stuck + 1 if still and self._steps > 12 else 0), turn
        if self._stuck > 14 or self._backings > 2:
            self._again()
            return self._toward(view, pos + 0.08 * back, view.eef_mat, OPEN)
        lift = style.slope * (aside - 0.008) + 0.3 * max(turn - ARRIVED_TURN, 0.0)
        lift = self._backed_off(aside, -float(error @ back), np.clip(lift, 0.0, self._rise + style.hover))
        over, far = self._over(view, goal, back, lift, aside)
        lateral = 1.0
        if far or back[2] > 0.9:
            lateral = np.clip(1.0 - (over[2] - pos[2] - 0.02) / 0.04, 0.0, 1.0)
        return self._toward(view, over, mat, OPEN, lateral)

    def _over(
        self, view: StateView, goal: np.ndarray, back: np.ndarray, lift: float, aside: float
    ) -> tuple[np.ndarray, bool]:
        """Where to go on the way to a hold, (3,), and whether that is to pass over what stands between.

        A hand that leans joins its approach where that is higher than what it passes; one that comes nearly level
        comes down before the hold.
        """
        over = goal + lift * back
        level = back[2] < LEVEL
        far = float(np.linalg.norm((over - view.eef_pos)[:2])) > 0.03 if level else aside > 0.05
        if not (far and aside > 0.05):
            return over, False
        height = self._in_the_way(view, over, AROUND) + FINGER_CLEARANCE + lowest(view.eef_mat)
        if level:
            return np.array([*over[:2], max(over[2], height)]), True
        return over + max(height - over[2], 0.0) / back[2] * back, True

    def _backed_off(self, aside: float, height: float, lift: float) -> float:
        """The lift, or all of it while a finger that came to stand on something goes back and to the middle."""
        standing = height > lift + STANDING and np.linalg.norm(self._velocity) < STILL
        self._pressed = self._pressed + 1 if standing and self._steps > 5 else 0
        if self._pressed >= 3 and not self._backing:
            self._backing, self._backings = True, self._backings + 1
        if aside < 0.006 and height > self._rise - TIP_BELOW + 0.01:
            self._backing = False
        return self._rise + self.style.hover if self._backing else lift

    def _close(self, view: StateView) -> np.ndarray:
        opening = float(np.abs(view.finger_pos).sum())
        still = abs(opening - self._opening) < 4e-4
        self._opening = opening
        if self._steps > 4 + self.style.pause and still or self._steps > 15:
            if opening < 0.002:
                self._again()
                return self._toward(view, view.eef_pos + [0, 0, 0.05], self._hold.mat, OPEN)
            self._carrying, self._diverted = None, 0
            self._enter("carry")
            return self._carry(view)
        # the finger that is near the object stays, and the other one comes
        aside = float(np.linalg.norm(self._aside))
        come = self._aside * min(1.0, 0.5 * max(MAX_OPENING - opening, 0.0) / max(aside, 1e-9))
        return self._toward(view, self._hold.pos + come, self._hold.mat, CLOSE)

    def _carry(self, view: StateView) -> np.ndarray:
        if self._carrying is None:
            self._carrying = self._carry_to(view)
        move = self._carrying.next(view, self._velocity)
        if isinstance(move, Move):
            return self._toward(view, move.pos, move.mat, CLOSE, move.lateral, move.slow)
        if move == "lost":
            self._again()
            return self._toward(view, view.eef_pos, view.eef_mat, OPEN)
        if move != "there" and self._elsewhere(view, blocked=move == "blocked"):
            return self._toward(view, view.eef_pos, view.eef_mat, CLOSE)
        self._hold = Pose(view.eef_pos, view.eef_mat)
        self._enter("release")
        return self._release(view)

    def _carry_to(self, view: StateView, out: Pose | None = None) -> Carry:
        return Carry(view, self.atom, self._way, style=self.style, shapes=self.shapes, out=out)

    def _elsewhere(self, view: StateView, blocked: bool) -> bool:
        """Choose a place anew for what is in the hand as it is; False where there is none, or it was often enough."""
        self._diverted += 1
        if self._diverted > DIVERTED:
            return False
        if blocked:
            self._failures.append(Failure(None, self._way.place))
        try:
            way = choose_place(view, self.shapes, self.atom, self.share, self._failures)
        except LiberoError:
            return False
        out = self._carrying.way_out(view)
        self._way, self._steps = way, 0
        self._carrying = self._carry_to(view, out)
        return True

    def _release(self, view: StateView) -> np.ndarray:
        if self._steps <= self.style.pause:
            return self._toward(view, self._hold.pos, self._hold.mat, CLOSE)
        if self._steps == self.style.pause + 1:
            others = self.shapes.others(view, self._thing, spacing=DENSE)
            self._tight = crowding(others, view.eef_pos, view.eef_mat) > 0.0
        if self._steps > 10:
            self._enter("withdraw")
        return self._toward(view, self._hold.pos, self._hold.mat, self._let_go(view))

    def _let_go(self, view: StateView) -> float:
        """Open the fingers; where that would push others aside, no further than the object needs."""
        wide = float(np.abs(view.finger_pos).sum()) > self._opening + EASE
        return 0.0 if self._tight and wide else OPEN

    def _withdraw(self, view: StateView) -> np.ndarray:
        back = -self._hold.mat[:, 2]
        away = float((view.eef_pos - self._hold.pos) @ back)
        if away > 0.07 or self._steps > 20:
            if evaluate(self.atom, view):
                self._enter("rest")
            else:
                self._again(placed=True)
        gripper = OPEN if away > 0.05 else self._let_go(view)
        return self._toward(view, self._hold.pos + 0.10 * back, self._hold.mat, gripper)

    def _rest(self, view: StateView) -> np.ndarray:
        return np.array([0.0] * 6 + [OPEN])

    def _toward(
        self,
        view: StateView,
        goal: np.ndarray,
        mat: np.ndarray,
        gripper: float,
        lateral: float = 1.0,
        slow: bool = False,
    ) -> np.ndarray:
        style = self.style
        if lateral > RISING or self._anchor is None:
            self._anchor = view.eef_pos[:2].copy()
        else:  # a hand that turns drifts
            goal, lateral = np.array([*self._anchor, goal[2]]), 1.0
        return action_toward(
            view.eef_pos,
            view.eef_mat,
            goal,
            mat,
            velocity=self._velocity,
            gripper=gripper,
            gain=style.gain,
            speed=0.35 * style.speed if slow else style.speed,
            lateral=lateral,
        )

    def _grasp_pose(self, view: StateView) -> tuple[np.ndarray, np.ndarray]:
        """Where the grip site must be to take the object, following it when it moves a little."""
        grasp, then = self._way.grasp, self._way.pose
        shift = view.body_pos(self._thing) - then.pos
        along = grasp.mat[:, 1] * self.style.grasp_along
        return grasp.pos_world + shift + along, _about(grasp.mat[:, 2], -self.style.yaw) @ grasp.mat

    def _others(self, view: StateView) -> np.ndarray:
        return self.shapes.others(view, self._thing)

    def _in_the_way(self, view: StateView, goal: np.ndarray, radius: float) -> float:
        floor = view.scene.workspace.surface_height
        return obstacle_height(self._others(view), view.eef_pos, goal, radius, floor)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
