"""Carrying what the hand holds to its place: up, over, and down or in from a side."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from libero_env.expert.clearance import lowest, obstacle_height
from libero_env.expert.planning.pick_plan import ASIDE, Approach
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

BESIDE = 0.05  # m, to either side of the hand that carries
SLIPPED = 0.03  # m, that a body may move between the fingers
GENTLE = 0.005  # m, over what carries it, where a body is let go
LEVEL = 0.008  # m, over it, where one comes in from a side
SAG = 0.01  # m, at most, that a hand is told to be higher as its load draws it down
DROP = 0.06  # m, over its place, from which on a body is let fall and need not be there exactly
DEEP = 0.05  # m, that walls around a place are high over what a body stands on there
ALIGNED, ALIGNED_TURN = 0.008, 0.1  # m and rad, to where a body goes down between walls
ASTRAY = 0.03  # m, from there, where it goes up again
HELD = 0.012  # m, from the grip site to the nearest point of what is still held
BLOCKED = 0.03  # m, before its place, where something that stops a body is in its way
CORRECTED = 0.35  # rad, by which the hand turns to set right what turned in it
IDLE = 20  # steps without motion, from which on a place counts as out of reach
OUT = 30  # steps, to get out of where something is in the way

End = Literal["there", "blocked", "slipped", "lost"]


@dataclass(frozen=True)
class Move:
    """Where the hand goes now."""

    pos: np.ndarray  # (3,), m
    mat: np.ndarray  # (3, 3)
    lateral: float = 1.0
    slow: bool = False


class Carry:
    """The way of one body in the hand to one place.

    Args:
        view: when the body has been taken.
        atom: what shall hold in the end.
        way: where to.
        style: the manner.
        shapes: of the scene.
        out: where to go first, back out of where something was in the way.
    """

    def __init__(
        self,
        view: StateView,
        atom: Atom,
        way: Approach,
        *,
        style: MotionStyle,
        shapes: Shapes,
        out: Pose | None = None,
    ):
        self.atom, self.way, self.style, self.shapes = atom, way, style, shapes
        self._thing = atom.args[0]
        self._taken = self._offset(view)
        self._mat = way.hand_mat
        self._out, self._steps, self._pressed = out, 0, 0
        self._idle, self._turn = 0, 0.0  # steps in which nothing moved, and rad that the hand was to turn
        self._sinking = False  # between the walls around its place, or in from the side

    def next(self, view: StateView, velocity: np.ndarray) -> Move | End:
        """The next move; or `there`: to be let go, `blocked`: something is in the way, `slipped`: but still held."""
        pos, entry = view.eef_pos, self.way.place.entry
        self._steps += 1
        offset = self._offset(view)
        if np.linalg.norm(offset - self._taken) > SLIPPED + 0.3 * np.linalg.norm(self._taken):
            cloud = self.shapes.cloud(view, self._thing)
            return "slipped" if np.linalg.norm(cloud - pos, axis=1).min() < HELD else "lost"
        if self._out is not None:
            if np.linalg.norm(self._out.pos - pos) > 0.015 and self._steps < OUT:
                return Move(self._out.pos, self._out.mat)
            self._out, self._steps = None, 0
        if not self._sinking:
            self._mat = self._corrected(view)
        gentle = GENTLE if entry[2] < -0.5 else LEVEL
        goal = self.way.place.pos + [0, 0, self.way.lift + gentle] - self._mat @ offset
        goal[:2] += (1.0 if self.way.lift > DROP else 0.2) * np.array(self.style.place_xy)
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, self._mat)))
        slow = self._steps > 20 and np.linalg.norm(velocity) < 0.01
        self._idle = self._idle + 1 if slow and abs(turn - self._turn) < 0.01 else 0
        self._turn = turn
        if self._idle > IDLE:
            return "blocked"
        hang = max(pos[2] - self.shapes.span(view, self._thing)[0], lowest(view.eef_mat), lowest(self._mat))
        if entry[2] < -0.5:
            return self._down(view, goal, turn, hang, bool(slow))
        return self._aside(view, goal, turn, hang, bool(slow))

    def way_out(self, view: StateView) -> Pose:
        """Back out of where the body is now: along its entry, or up over what is around."""
        entry, pos = self.way.place.entry, view.eef_pos
        if entry[2] < -0.5:
            hang = max(pos[2] - self.shapes.span(view, self._thing)[0], lowest(view.eef_mat))
            high = self._highest(view, pos) + hang
            return Pose(np.array([*pos[:2], max(pos[2], high + self.style.margin)]), view.eef_mat)
        goal = self.way.place.pos + [0, 0, GENTLE] - self._mat @ self._offset(view)
        return Pose(goal - ASIDE * entry if self._sinking else pos, view.eef_mat)

    def _down(self, view: StateView, goal: np.ndarray, turn: float, hang: float, slow: bool) -> Move | End:
        """Over the place in a funnel; where there are walls around it, not down before the body is in the middle."""
        pos, style, drop = view.eef_pos, self.style, self.way.lift > DROP
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        self._pressed = self._pressed + 1 if slow and away < 0.04 else 0
        arrived = away < (0.025 if drop else 0.014) and turn < 0.2
        if arrived and pos[2] < goal[2] + (0.02 if drop else 0.006):
            return "there"
        if self._pressed > 6:
            return "blocked" if pos[2] - goal[2] > BLOCKED else "there"
        around = (
            obstacle_height(self._others(view), goal, goal, 0.05, self._floor(view)) + hang + style.margin
        )
        over = goal.copy()
        funnel = style.slope * (away - (0.03 if drop else 0.012)) + 0.3 * max(turn - 0.12, 0.0)
        over[2] += np.clip(funnel, 0.0, 0.04)
        if self._above(away, turn, around - style.margin - goal[2] > DEEP and not drop, slow):
            over[2] = max(over[2], around, self._highest(view, goal) + hang + 0.7 * style.margin)
        lateral = np.clip(1.0 - (over[2] - pos[2]) / 0.05, 0.0, 1.0)
        return Move(over, self._mat, lateral, slow=pos[2] - goal[2] < 0.04 and away < 0.05)

    def _above(self, away: float, turn: float, deep: bool, slow: bool) -> bool:
        """Whether the body is to stay over what is around its place."""
        if not deep:
            return away > 0.03 or turn > 0.4
        if away < ALIGNED and turn < ALIGNED_TURN or slow and away < 0.6 * ASTRAY:
            self._sinking = True
        elif away > ASTRAY or turn > 0.4:
            self._sinking = False
        return not self._sinking

    def _aside(self, view: StateView, goal: np.ndarray, turn: float, hang: float, slow: bool) -> Move | End:
        """Over to a point before the place, down, and in along the entry."""
        pos, entry = view.eef_pos, self.way.place.entry
        pre = goal - ASIDE * entry
        if not self._sinking:
            self._sinking = bool(np.linalg.norm(pre - pos) < 0.02 and turn < 0.2)
            over = pre.copy()
            if np.linalg.norm(pre[:2] - pos[:2]) > 0.04 or turn > 0.4:
                over[2] = max(over[2], self._highest(view, pre) + hang + 0.7 * self.style.margin)
            return Move(over, self._mat, np.clip(1.0 - (over[2] - pos[2]) / 0.05, 0.0, 1.0))
        left = float((goal - pos) @ entry)
        self._pressed = self._pressed + 1 if slow else 0
        if left < 0.003 and np.linalg.norm(goal - pos) < 0.03:
            return "there"
        if self._pressed > 8:
            return "there" if left < 0.012 or evaluate(self.atom, view) else "blocked"
        sag = np.clip(goal[2] - pos[2], 0.0, SAG)
        return Move(goal - max(left - 0.06, 0.0) * entry + [0, 0, sag], self._mat)

    def _corrected(self, view: StateView) -> np.ndarray:
        """The hand's orientation at the place, (3, 3), for the body as it is turned in the hand now."""
        held = self.way.place.mat @ pose_of(view, self._thing).mat.T @ view.eef_mat
        turn = rotation_between(self.way.hand_mat, held)
        angle = float(np.linalg.norm(turn))
        if angle < 1e-6:
            return held
        return _about(turn / angle, min(angle, CORRECTED)) @ self.way.hand_mat

    def _offset(self, view: StateView) -> np.ndarray:
        """Of the body from the grip site, in the hand's frame, (3,)."""
        return view.eef_mat.T @ (view.body_pos(self._thing) - view.eef_pos)

    def _highest(self, view: StateView, goal: np.ndarray) -> float:
        """Height of the highest thing that the body and the hand pass on the way of the hand to a goal, m."""
        points = self.shapes.points(view, self._thing, 0.02)[:, :2]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - middle, axis=1).max()) + 0.01
        aside = np.array([*(middle - view.eef_pos[:2]), 0.0])
        others, floor = self._others(view), self._floor(view)
        body = obstacle_height(others, view.eef_pos + aside, goal + aside, radius, floor)
        return max(body, obstacle_height(others, view.eef_pos, goal, BESIDE, floor))

    def _others(self, view: StateView) -> np.ndarray:
        return self.shapes.others(view, self._thing)

    def _floor(self, view: StateView) -> float:
        return view.scene.workspace.surface_height


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
