"""Transport of an object in the hand to its place: up, over obstacles, and down or in from a side."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from libero_env.expert.arm import lateral_ramp
from libero_env.expert.clearance import hand_extent_below, overhang
from libero_env.expert.planning.pick_plan import ENTRY_DISTANCE, PickPlan
from libero_env.expert.shapes import COARSE, Shapes, pose_of
from libero_env.expert.skills.skill import funnel_lift
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_about, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

HAND_RADIUS = 0.05  # [m] around the grip site that has to be free of obstacles
MAX_SLIP = 0.03  # [m] that an object may move in the hand
MAX_HELD_DISTANCE = 0.012  # [m] from the grip site to the nearest point of an object that is still held
MAX_CORRECTION = 0.35  # [rad] that the hand rotates to compensate for a rotation of the object in it
RELEASE_GAP, SIDE_GAP = 0.005, 0.008  # [m] above the place, from above and from a side
MIN_DROP = 0.06  # [m] of drop height from which on the position needs less accuracy
ACCURACY = 0.014  # [m] from the place, within which an object is lowered onto it
ROOM_SHARE = 0.6  # of the room that a narrow place leaves
MIN_ACCURACY = 0.004  # [m]
MIN_WALL = 0.05  # [m] of walls around a place, from which on an object goes down only from their middle
ALIGNED, ALIGNED_TURN = 0.008, 0.1  # [m], [rad] from the middle, where it goes down
MISALIGNED, MISALIGNED_TURN = 0.03, 0.4  # [m], [rad] from the middle, where it goes up again
MAX_SAG = 0.01  # [m] that a hand is commanded to be higher, as its load draws it down
# a hand that brakes before it lets go cannot be cloned: the clone comes to rest just short of where the fingers open
SINKING = 0.02  # [m] below its place, or behind it, where the hand is commanded to
BLOCKED_DISTANCE = 0.03  # [m] before its place, at which an object that stops is blocked
# an object that stands below a fixture, such as a drawer just opened, is drawn out before it is lifted
CLEAR = 0.03  # [m] around the object over which no fixture may hang, as a clone does not rise as straight
OVERHANG_HEIGHT = 0.25  # [m] above the object, up to which something is in its way
DRAW_OUT = 0.06  # [m] of the target ahead of the hand, and least distance to the place
MIN_ASIDE = 0.1  # of the object's radius, from its middle to that of the overhang: else no way out is seen
WIDE_BERTH = 0.03  # [m] by which such an object is carried higher: it has what hung over it close beside it
HEADROOM, DRAW_UP = 0.05, 0.03  # [m] above the object, from which on it also rises on its way, by so much
MAX_IDLE_STEPS = 20  # steps without motion after which a place is out of reach
MAX_EXIT_STEPS = 30  # steps to back out of where something blocks the way

Outcome = Literal["arrived", "blocked", "slipped", "lost"]


@dataclass(frozen=True)
class Move:
    """Target of the hand.

    Attributes:
        pos: Position of the grip site, (3,), [m].
        mat: Orientation of the grip site, (3, 3).
        lateral_scale: Factor on the horizontal part of the motion, in [0, 1].
        slow: Whether to move slowly.
    """

    pos: np.ndarray
    mat: np.ndarray
    lateral_scale: float = 1.0
    slow: bool = False


class Transport:
    """Motion of one object in the hand to one place.

    Args:
        view: State in which the object has been grasped.
        atom: Atom to make true.
        plan: Where the object is released.
        exit_pose: Pose to go to first, away from where something blocked the way.
    """

    def __init__(
        self,
        view: StateView,
        atom: Atom,
        plan: PickPlan,
        *,
        style: MotionStyle,
        shapes: Shapes,
        exit_pose: Pose | None = None,
    ):
        self.atom, self.plan, self.style, self.shapes = atom, plan, style, shapes
        self._object = atom.args[0]
        self._grasp_offset = self._offset(view)
        self._mat = plan.release_mat
        self._exit_pose, self._steps = exit_pose, 0
        self._blocked_steps = 0  # in which something resisted the way in
        self._idle_steps, self._previous_turn = 0, 0.0  # without motion; [rad] that the hand had to rotate
        self._clearance = style.carry_clearance  # [m] over what the object passes
        self._accuracy = max(min(ACCURACY, ROOM_SHARE * plan.place.room), MIN_ACCURACY)  # [m] from the place
        self._is_covered = True  # by a fixture, as far as is known
        self._inserting = False  # on the last part of the way: down between walls, or in from a side

    @property
    def onward(self) -> np.ndarray:
        """Way that the hand goes on while the fingers begin to open, (3,), [m]; none where the object is dropped."""
        place = self.plan.place
        if not place.from_above:
            return SINKING * place.entry
        return np.array([0.0, 0.0, 0.0 if self.plan.drop_height > MIN_DROP else -SINKING])

    def next_move(self, view: StateView, velocity: np.ndarray) -> Move | Outcome:
        """Return the next target of the hand, or how the transport ended.

        Args:
            velocity: Velocity of the grip site, (3,), [m/s].

        Returns:
            A `Move`; or `arrived`: release the object; `blocked`: something is in the way; `slipped`: the object has
            moved in the hand and is still held; `lost`: it is not.
        """
        pos, place = view.eef_pos, self.plan.place
        self._steps += 1
        offset = self._offset(view)
        if np.linalg.norm(offset - self._grasp_offset) > MAX_SLIP + 0.3 * np.linalg.norm(self._grasp_offset):
            distances = np.linalg.norm(self.shapes.cloud(view, self._object) - pos, axis=1)
            return "slipped" if distances.min() < MAX_HELD_DISTANCE else "lost"
        if self._exit_pose is not None:
            if np.linalg.norm(self._exit_pose.pos - pos) > 0.015 and self._steps < MAX_EXIT_STEPS:
                return Move(self._exit_pose.pos, self._exit_pose.mat)
            self._exit_pose, self._steps = None, 0
        if not self._inserting:
            self._mat = self._corrected_release_mat(view)
        gap = RELEASE_GAP if place.from_above else SIDE_GAP
        goal = place.pos + [0, 0, self.plan.drop_height + gap] - self._mat @ offset
        goal[:2] += (1.0 if self.plan.drop_height > MIN_DROP else 0.2) * np.array(self.style.place_shift)
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, self._mat)))
        slow = bool(self._steps > 20 and np.linalg.norm(velocity) < 0.01)
        self._idle_steps = self._idle_steps + 1 if slow and abs(turn - self._previous_turn) < 0.01 else 0
        self._previous_turn = turn
        if self._idle_steps > MAX_IDLE_STEPS:
            return "blocked"
        below = max(self._extent_below(view), hand_extent_below(self._mat))
        if self._is_covered and np.linalg.norm(goal[:2] - pos[:2]) > DRAW_OUT:
            if (draw_out := self._draw_out(view)) is not None:
                self._clearance = self.style.carry_clearance + WIDE_BERTH
                return draw_out
            self._is_covered = False
        if place.from_above:
            return self._lower(view, goal, turn, below, slow)
        return self._enter_from_side(view, goal, turn, below, slow)

    def exit_pose(self, view: StateView) -> Pose:
        """Return the pose to which the hand backs out: against the entry, or up over the obstacles around."""
        place, pos = self.plan.place, view.eef_pos
        if place.from_above:
            high = self._path_height(view, pos) + self._extent_below(view)
            pos = np.array([*pos[:2], max(pos[2], high + self._clearance)])
        elif self._inserting:
            goal = place.pos + [0, 0, RELEASE_GAP] - self._mat @ self._offset(view)
            pos = goal - ENTRY_DISTANCE * place.entry
        return Pose(pos, view.eef_mat)

    def _draw_out(self, view: StateView) -> Move | None:
        """Return the motion away from the fixture that hangs over the object, or None where it can be lifted."""
        middle, radius, top = self._ground_plan(view)
        clouds = [self.shapes.points(view, name, COARSE) for name in view.scene.fixtures]
        fixtures = np.concatenate([*clouds, np.zeros((0, 3))])
        fixtures = fixtures[fixtures[:, 2] > view.scene.workspace.surface_height + 0.005]
        above = overhang(fixtures, middle, radius + CLEAR, top - 0.002, top + OVERHANG_HEIGHT)
        if not len(above):
            return None
        aside = middle - above[:, :2].mean(axis=0)
        distance = float(np.linalg.norm(aside))
        if distance < MIN_ASIDE * radius:
            return None
        rise = DRAW_UP if above[:, 2].min() - top > HEADROOM else 0.0
        return Move(view.eef_pos + [*(DRAW_OUT / distance * aside), rise], view.eef_mat)

    def _lower(
        self, view: StateView, goal: np.ndarray, turn: float, below: float, slow: bool
    ) -> Move | Outcome:
        """Move over the place and down a funnel; between walls, only once the object is in their middle.

        Args:
            goal: Position of the grip site at the place, (3,).
            turn: Angle to the orientation at the place, [rad].
            below: Extent of object and hand below the grip site, [m].
            slow: Whether the hand hardly moves.
        """
        pos, style, drops = view.eef_pos, self.style, self.plan.drop_height > MIN_DROP
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        self._blocked_steps = self._blocked_steps + 1 if slow and away < 0.04 else 0
        aligned = away < (0.025 if drops else self._accuracy) and turn < 0.2
        if aligned and pos[2] < goal[2] + (0.02 if drops else 0.012):
            return "arrived"
        if self._blocked_steps > 1:
            return "blocked" if pos[2] - goal[2] > BLOCKED_DISTANCE else "arrived"
        walls = self.shapes.highest(view, self._object, (goal, goal, 0.05))
        over_walls = walls + below + self._clearance
        target = goal.copy()
        width = 0.03 if drops else self._accuracy - 0.002
        target[2] += funnel_lift(style.funnel_slope, away - width, turn - 0.12, 0.04)
        if aligned and not drops:
            target[2] -= SINKING
        deep = over_walls - self._clearance - goal[2] > MIN_WALL and not drops
        if self._stays_above(away, turn, deep, slow):
            over_path = self._path_height(view, goal) + below + 0.7 * self._clearance
            target[2] = max(target[2], over_walls, over_path)
        lateral_scale = lateral_ramp(pos[2], target[2], 0.0, 0.05)
        mat = view.eef_mat if lateral_scale == 0.0 and self._is_beside_obstacles(view) else self._mat
        return Move(target, mat, lateral_scale, slow=bool(pos[2] - goal[2] < 0.04 and away < 0.05))

    def _is_beside_obstacles(self, view: StateView) -> bool:
        """Return whether something near the hand is higher than its fingertips: a hand that rotates there hits it."""
        pos = view.eef_pos
        height = self.shapes.highest(view, self._object, (pos, pos, 2 * HAND_RADIUS))
        return height > pos[2] - hand_extent_below(view.eef_mat)

    def _stays_above(self, away: float, turn: float, deep: bool, slow: bool) -> bool:
        """Return whether the object stays above the obstacles around its place.

        Args:
            away: Horizontal distance to the place, [m].
            turn: Angle to the orientation at the place, [rad].
            deep: Whether there are walls around the place.
            slow: Whether the hand hardly moves.
        """
        if not deep:
            return away > MISALIGNED or turn > MISALIGNED_TURN
        if away < ALIGNED and turn < ALIGNED_TURN or slow and away < 0.6 * MISALIGNED:
            self._inserting = True
        elif away > MISALIGNED or turn > MISALIGNED_TURN:
            self._inserting = False
        return not self._inserting

    def _enter_from_side(
        self, view: StateView, goal: np.ndarray, turn: float, below: float, slow: bool
    ) -> Move | Outcome:
        """Move to a point before the place, then in along the entry; arguments as of `_lower`."""
        pos, entry = view.eef_pos, self.plan.place.entry
        if not self._inserting:
            before = goal - ENTRY_DISTANCE * entry
            self._inserting = bool(np.linalg.norm(before - pos) < 0.02 and turn < 0.2)
            target = before.copy()
            if np.linalg.norm(before[:2] - pos[:2]) > 0.04 or turn > 0.4:
                high = self._path_height(view, before) + below + 0.7 * self._clearance
                target[2] = max(target[2], high)
            return Move(target, self._mat, lateral_ramp(pos[2], target[2], 0.0, 0.05))
        left = float((goal - pos) @ entry)
        self._blocked_steps = self._blocked_steps + 1 if slow else 0
        if left < self._accuracy and np.linalg.norm(goal - pos) < 0.03:
            return "arrived"
        if self._blocked_steps > 1 and (left < 0.012 or evaluate(self.atom, view)):
            return "arrived"
        if self._blocked_steps > 8:
            return "blocked"
        sag = np.clip(goal[2] - pos[2], 0.0, MAX_SAG)
        ahead = min(SINKING, 0.06 - left)
        return Move(goal + ahead * entry + [0, 0, sag], self._mat, slow=left < 0.04)

    def _corrected_release_mat(self, view: StateView) -> np.ndarray:
        """Return the hand's orientation at the place, (3, 3), for the object as it is rotated in the hand now."""
        required = self.plan.place.mat @ pose_of(view, self._object).mat.T @ view.eef_mat
        turn = rotation_between(self.plan.release_mat, required)
        angle = float(np.linalg.norm(turn))
        if angle < 1e-6:
            return required
        return rotation_about(turn / angle, min(angle, MAX_CORRECTION)) @ self.plan.release_mat

    def _offset(self, view: StateView) -> np.ndarray:
        """Return the position of the object in the frame of the grip site, (3,)."""
        return view.eef_mat.T @ (view.body_pos(self._object) - view.eef_pos)

    def _extent_below(self, view: StateView) -> float:
        """Return how far object and hand reach below the grip site, [m]."""
        lowest, _ = self.shapes.height_range(view, self._object)
        return max(view.eef_pos[2] - lowest, hand_extent_below(view.eef_mat))

    def _path_height(self, view: StateView, goal: np.ndarray) -> float:
        """Return the height of the highest obstacle that object and hand pass on the way to a goal (3,), [m]."""
        middle, radius, _ = self._ground_plan(view)
        pos = view.eef_pos
        offset = np.array([*(middle - pos[:2]), 0.0])
        of_object = pos + offset, goal + offset, radius + 0.01
        return self.shapes.highest(view, self._object, of_object, (pos, goal, HAND_RADIUS))

    def _ground_plan(self, view: StateView) -> tuple[np.ndarray, float, float]:
        """Return the middle of the object in the ground plan, (2,), its radius there, and its top, [m]."""
        points = self.shapes.points(view, self._object, 0.02)
        plan = points[:, :2]
        middle = 0.5 * (plan.min(axis=0) + plan.max(axis=0))
        return middle, float(np.linalg.norm(plan - middle, axis=1).max()), float(points[:, 2].max())
