"""Dragging an object that is too wide and flat to be grasped: a fingertip in its hollow moves it over the table."""

import numpy as np

from libero_env.expert.arm import CLOSE, GRIPPER, downward, finger_axis, lateral_ramp
from libero_env.expert.planning.detour import Detour
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.expert.skills.skill import Skill, gripper_opening
from libero_env.expert.variation import MotionStyle
from libero_env.sim.predicates import region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

HOLLOW_RADIUS, MIN_HOLLOW = 0.02, 0.006  # [m] around the origin, and its depth below the rim
HOVER = 0.07  # [m] of the fingertips over the object on the way to it
LEAD = 0.035  # [m] of the target ahead of the hand while it drags
NEAR = 0.02  # [m] above where the hand presses on the object, from which on it counts as blocked
PRESS = -0.006  # [m] of the fingertips over the bottom of the hollow: the hand presses, and friction helps
LOW = 0.05  # [m] of obstacles over the table, which the hand passes above
DRAG_SPEED = 0.6  # factor on the speed


class Drag(Skill):
    """Skill that makes an (On object region-of-the-table) true for an object with a hollow, such as a plate.

    Phases: reach, carry, withdraw, rest.

    Args:
        atom: Atom to make true.
        avoid: Whether the object goes around others, not straight.
    """

    NOISE_SCALES = {"reach": 1.0, "carry": 0.3}

    def __init__(self, atom: Atom, *, style: MotionStyle, shapes: Shapes, avoid: bool = False):
        super().__init__(atom, style)
        self.shapes, self.avoid = shapes, avoid
        self._detour: Detour | None = None
        self._still_steps = 0  # just above the object, where something keeps the hand from going lower

    @staticmethod
    def applies(view: StateView, shapes: Shapes, atom: Atom) -> bool:
        """Return whether the place is on the table and the object is upright and has a hollow at its origin."""
        region = view.scene.problem.region(atom.args[1])
        flat = region is not None and bool(region.ranges) and region.target == view.scene.workspace_name
        points = shapes.cloud(view, atom.args[0]) - view.body_pos(atom.args[0])
        hollow = points[np.hypot(points[:, 0], points[:, 1]) < HOLLOW_RADIUS, 2]
        upright = pose_of(view, atom.args[0]).mat[2, 2] > 0.9
        return bool(flat and upright and len(hollow) > 0 and points[:, 2].max() - hollow.max() > MIN_HOLLOW)

    def _next_action(self, view: StateView) -> np.ndarray:
        if self.phase == "rest":
            self.phase = "reach"
        return self._run_phase(view)

    def _reach(self, view: StateView) -> np.ndarray:
        """Move over the middle of the object, then down into the hollow."""
        pos, goal = view.eef_pos, self._contact_pos(view)
        target = goal.copy()
        still = np.linalg.norm(self._velocity) < 0.01 and pos[2] < goal[2] + NEAR
        self._still_steps = self._still_steps + 1 if still else 0
        if (
            np.linalg.norm(goal[:2] - pos[:2]) > (0.025 if self.avoid else 0.015)
            or gripper_opening(view) > 0.01
        ):
            target[2] = float(self.shapes.cloud(view, self.atom.args[0])[:, 2].max()) + HOVER
        elif pos[2] < goal[2] + 0.006 or self._still_steps > 1 or self._steps > 90:
            self._enter("carry")
        return self._push(view, target, lateral_scale=lateral_ramp(pos[2], target[2], 0.0, 0.06))

    def _carry(self, view: StateView) -> np.ndarray:
        pos, name = view.eef_pos, self.atom.args[0]
        origin, contact = view.body_pos(name), self._contact_pos(view)
        centres = (box[0][:2] for box in region_boxes(view, self.atom.args[1]))
        path = min(centres, key=lambda centre: float(np.linalg.norm(centre - origin[:2]))) - origin[:2]
        if self.avoid:
            self._detour = self._detour or self._way_around(view)
            path = self._detour.path(origin[:2])
        left = float(np.linalg.norm(path))
        lost = np.linalg.norm(pos[:2] - origin[:2]) > 0.10 or self._steps > 150
        if left < 0.012 or lost:
            self._enter("withdraw")
            self.retries += int(lost)
            if self.retries > self.MAX_RETRIES:
                self.failure_reason = f"{name} does not follow the hand"
        ahead = path / max(left, 1e-9) * min(left + 0.01, LEAD)
        return self._push(view, np.array([*(pos[:2] + ahead), contact[2]]), speed_scale=DRAG_SPEED)

    def _withdraw(self, view: StateView) -> np.ndarray:
        if self._steps > 8:
            self.phase = "rest"
        return self._push(view, view.eef_pos + [0, 0, 0.08])

    def _way_around(self, view: StateView) -> Detour:
        """Return the way of the object to its place, around what it or the hand would touch."""
        name, surface = self.atom.args[0], view.scene.workspace.surface_height
        middle = view.body_pos(name)[:2]
        radius = float(np.linalg.norm(self.shapes.cloud(view, name)[:, :2] - middle, axis=1).max())
        x, y, z = self.shapes.obstacles(view, name).T
        rows = np.column_stack([np.round(x, 2), np.round(y, 2), z > surface + LOW])
        points = np.unique(rows, axis=0)
        radii = np.where(points[:, 2], max(radius, GRIPPER.palm_half_length), radius)
        return Detour(middle, points[:, :2], radii, region_boxes(view, self.atom.args[1]))

    def _contact_pos(self, view: StateView) -> np.ndarray:
        """Return the position of the grip site with the closed fingertips in the hollow, (3,)."""
        points, origin = self.shapes.cloud(view, self.atom.args[0]), view.body_pos(self.atom.args[0])
        hollow = points[np.hypot(*(points - origin)[:, :2].T) < HOLLOW_RADIUS, 2].max()
        return np.array([*origin[:2], hollow + GRIPPER.tip_below + PRESS])

    def _push(
        self, view: StateView, pos: np.ndarray, lateral_scale: float = 1.0, speed_scale: float = 1.0
    ) -> np.ndarray:
        """Return the action towards a position of the closed hand, which points down."""
        mat = downward(float(np.arctan2(*view.eef_mat[1::-1, 0])), finger_axis(view.eef_mat))
        return self._toward(view, pos, mat, CLOSE, lateral_scale, speed_scale)
