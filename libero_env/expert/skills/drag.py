"""Moving something too wide and flat to take: a fingertip in its hollow draws it over the table."""

import numpy as np

from libero_env.expert.arm.gripper import TIP_BELOW
from libero_env.expert.arm.servo import CLOSE, action_toward, downward, finger_axis
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.expert.skills.pick_place import CONTROL_HZ
from libero_env.expert.variation import MotionStyle
from libero_env.sim.predicates import evaluate
from libero_env.sim.regions import region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

ATTEMPTS = 5
OVER = 0.07  # m, of the fingertips over the body on the way to it
LEAD = 0.035  # m, of the goal ahead of the hand while it draws
LIGHT = -0.006  # m over the bottom of the hollow: it presses, and friction helps


class Drag:
    """Makes an (On thing region-of-the-table) true for a body with a hollow, such as a plate; as `PickPlace`."""

    def __init__(self, atom: Atom, *, style: MotionStyle, shapes: Shapes):
        self.atom, self.style, self.shapes = atom, style, shapes
        self.phase = "reach"
        self.retries, self.failure_reason = 0, ""
        self._steps = 0
        self._before: np.ndarray | None = None
        self._velocity = np.zeros(3)

    @staticmethod
    def suits(view: StateView, shapes: Shapes, atom: Atom) -> bool:
        """Whether the place is on the table and the body has a hollow over its origin."""
        region = view.scene.problem.region(atom.args[1])
        flat = region is not None and bool(region.ranges) and region.target == view.scene.workspace_name
        points = shapes.cloud(view, atom.args[0]) - view.body_pos(atom.args[0])
        inner = points[np.hypot(points[:, 0], points[:, 1]) < 0.02, 2]
        upright = pose_of(view, atom.args[0]).mat[2, 2] > 0.9
        return flat and upright and len(inner) > 0 and points[:, 2].max() - inner.max() > 0.006

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]."""
        return {"reach": 1.0, "carry": 0.3}.get(self.phase, 0.0)

    def done(self, view: StateView) -> bool:
        """Whether the atom holds and the hand is away."""
        return self.phase in ("reach", "rest") and evaluate(self.atom, view)

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1]."""
        pos, thing = view.eef_pos, self.atom.args[0]
        self._velocity = (pos - (pos if self._before is None else self._before)) * CONTROL_HZ
        self._before = pos
        self._steps += 1
        points = self.shapes.cloud(view, thing)
        origin = view.body_pos(thing)
        hollow = points[np.hypot(*(points - origin)[:, :2].T) < 0.02, 2].max()
        target = min(
            (box[0][:2] for box in region_boxes(view, self.atom.args[1])),
            key=lambda c: np.linalg.norm(c - origin[:2]),
        )
        way = target - origin[:2]
        left = float(np.linalg.norm(way))
        mat = downward(float(np.arctan2(*view.eef_mat[1::-1, 0])), finger_axis(view.eef_mat))
        low = hollow + TIP_BELOW + LIGHT
        if self.phase == "rest":
            self.phase = "reach"
        if self.phase == "reach":
            return self._reach(view, mat, np.array([*origin[:2], low]), float(points[:, 2].max()))
        if self.phase == "carry":
            lost = np.linalg.norm(pos[:2] - origin[:2]) > 0.10 or self._steps > 150
            if left < 0.012 or lost:
                self.phase, self._steps = "withdraw", 0
                self.retries += int(lost)
                if self.retries > ATTEMPTS:
                    self.failure_reason = f"{thing} does not follow the hand"
            ahead = way / max(left, 1e-9) * min(left + 0.01, LEAD)
            return self._toward(view, np.array([*(pos[:2] + ahead), low]), mat, 0.6)
        if self._steps > 8:
            self.phase = "rest"
        return self._toward(view, pos + [0, 0, 0.08], mat)

    def _reach(self, view: StateView, mat: np.ndarray, goal: np.ndarray, top: float) -> np.ndarray:
        """Over the body's middle, then down into the hollow."""
        pos = view.eef_pos
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        over = goal.copy()
        if away > 0.015 or np.abs(view.finger_pos).sum() > 0.01:
            over[2] = top + OVER
        elif pos[2] < goal[2] + 0.006 or self._steps > 90:
            self.phase, self._steps = "carry", 0
        lateral = np.clip(1.0 - (over[2] - pos[2]) / 0.06, 0.0, 1.0)
        return self._toward(view, over, mat, lateral=lateral)

    def _toward(
        self, view: StateView, goal: np.ndarray, mat: np.ndarray, speed: float = 1.0, lateral: float = 1.0
    ):
        return action_toward(
            view.eef_pos,
            view.eef_mat,
            goal,
            mat,
            velocity=self._velocity,
            gripper=CLOSE,
            gain=self.style.gain,
            speed=speed * self.style.speed,
            lateral=lateral,
        )
