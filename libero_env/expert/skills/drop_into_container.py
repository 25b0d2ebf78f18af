"""Dropping an object into an open container, with the hand straight down above the rim."""

import numpy as np

from libero_env.expert.arm import CLOSE, GRIPPER, OPEN, downward, finger_axis, joint_angles, lateral_ramp
from libero_env.expert.grasping.grasps import GraspError, choose_top_grasp
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.expert.skills.pick_place import (
    ARRIVED,
    ARRIVED_TURN,
    FINGER_CLEARANCE,
    OBSTACLE_RADIUS,
    STANDING,
    PickPlace,
    has_moved,
)
from libero_env.expert.skills.skill import BackOff, Skill, funnel_lift
from libero_env.expert.variation import MotionStyle
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

MAX_BACK_OFFS = 3
MAX_REACH_ERROR = 0.005  # of inverse kinematics at the grasp, [m]
MAX_SLIP = 0.03  # [m] that the object may move in the hand
HAND_ABOVE_RIM = 0.045  # [m] of the grip site, so that the palm stays above the container


class DropIntoContainer(Skill):
    """Skill that makes an (In object region) true where the region belongs to a movable container, such as a basket.

    It is shorter and more reliable than `PickPlace` where it applies, and its motion is easy to clone. `PickPlace`
    takes over where it fails. Phases: reach (down a funnel over the grasp), close, carry (up, over and a little down),
    release, rest. An object that slipped, tipped or fell beside the container is picked again.

    Args:
        atom: Atom to make true.
        container: Name of the object that the region belongs to.
    """

    NOISE_SCALES = {"reach": 1.0, "carry": 0.7}
    MAX_RETRIES = 4

    def __init__(self, atom: Atom, container: str, *, style: MotionStyle, shapes: Shapes):
        super().__init__(atom, style)
        self.container, self.shapes = container, shapes
        self._object, self._site = atom.args
        # position and yaw of the grasp, and the pose of the object then
        self._plan: tuple[np.ndarray, float, Pose] | None = None
        self._clear_height = 0.0  # [m] above the grasp, at which the fingertips are clear of the object
        self._hold_pose = Pose(np.zeros(3), np.eye(3))  # to keep while the fingers move
        self._grasp_offset = np.zeros(3)  # of the object from the grip site when it was grasped
        self._back_off = BackOff()

    @classmethod
    def for_atom(
        cls, view: StateView, atom: Atom, *, style: MotionStyle, shapes: Shapes
    ) -> "DropIntoContainer | None":
        """Return the skill with its grasp, where the container is movable and the object can be grasped from above."""
        region = view.scene.problem.region(atom.args[-1])
        if atom.predicate != "In" or region is None or region.ranges:
            return None
        if region.target not in view.scene.objects:
            return None
        try:
            skill = cls(atom, region.target, style=style, shapes=shapes)
            grasp = skill._grasp_pose(view, MotionStyle())
        except GraspError:
            return None
        above = Pose(grasp.pos + [0.0, 0.0, 0.1], grasp.mat)
        _, error = shapes.arm.follow(joint_angles(view), [above, grasp])
        return skill if error < MAX_REACH_ERROR else None

    def fallback(self) -> PickPlace | None:
        """Return `PickPlace`, which searches more grasps, after a failure."""
        return PickPlace(self.atom, style=self.style, shapes=self.shapes) if self.failure_reason else None

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._back_off.stop()

    def _start(self, phase: str, view: StateView) -> np.ndarray:
        self._enter(phase)
        self._steps = 1  # here, the step in which a phase begins counts
        return self._run_phase(view)

    def _reach(self, view: StateView) -> np.ndarray:
        pos, style = view.eef_pos, self.style
        try:
            grasp = self._grasp_pose(view, self.style)
        except GraspError as error:
            self.failure_reason = str(error)
            return self._rise()
        goal = grasp.pos
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        turn = float(np.linalg.norm(rotation_between(view.eef_mat, grasp.mat)))
        if away < ARRIVED and abs(goal[2] - pos[2]) < ARRIVED and turn < ARRIVED_TURN:
            self._hold_pose = grasp
            return self._start("close", view)
        full_lift = self._clear_height + style.hover
        lift = funnel_lift(style.funnel_slope, away - 0.008, turn - ARRIVED_TURN, full_lift)
        self._back_off.update(
            standing=pos[2] > goal[2] + lift + STANDING and self._is_still() and self._steps > 5,
            clear=away < 0.006 and pos[2] > goal[2] + self._clear_height - GRIPPER.tip_below + 0.01,
        )
        if self._back_off.count > MAX_BACK_OFFS:
            self.failure_reason = f"something is in the way of grasping {self._object} from above"
        target = goal.copy()
        target[2] += full_lift if self._back_off.active else lift
        if away > 0.05:
            obstacles = self.shapes.highest(view, self._object, (pos, goal, OBSTACLE_RADIUS))
            target[2] = max(target[2], obstacles + FINGER_CLEARANCE + GRIPPER.tip_below)
        lateral_scale = lateral_ramp(pos[2], target[2], 0.02, 0.04)
        return self._toward(view, target, grasp.mat, OPEN, lateral_scale)

    def _close(self, view: StateView) -> np.ndarray:
        pose = self._hold_pose
        if not self._fingers_stopped(view):
            return self._toward(view, pose.pos, pose.mat, CLOSE)
        if self._opening < 0.004:
            self._retry()
            return self._toward(view, view.eef_pos + [0, 0, 0.05], pose.mat, OPEN)
        self._grasp_offset = view.body_pos(self._object) - view.eef_pos
        return self._start("carry", view)

    def _carry(self, view: StateView) -> np.ndarray:
        pos, mat, style = view.eef_pos, self._hold_pose.mat, self.style
        offset = view.body_pos(self._object) - pos
        if np.linalg.norm(offset - self._grasp_offset) > MAX_SLIP + 0.3 * abs(self._grasp_offset[2]):
            self._retry()
            return self._start("reach", view)
        below = max(pos[2] - self.shapes.height_range(view, self._object)[0], GRIPPER.tip_below)
        rim = self.shapes.height_range(view, self.container)[1]
        goal = view.site_pos(self._site) - offset
        goal[:2] += style.place_shift
        away = float(np.linalg.norm(goal[:2] - pos[:2]))
        high = rim + below + style.carry_clearance
        low = max(rim + below - style.drop_depth, rim + HAND_ABOVE_RIM)
        goal[2] = high if away > 0.03 else min(low, high)
        if away < 0.025 and pos[2] < goal[2] + 0.02:
            self._hold_pose = Pose(np.array([*goal[:2], min(goal[2], pos[2])]), mat)
            return self._start("release", view)
        obstacles = self.shapes.highest(view, self._object, (pos, goal, OBSTACLE_RADIUS))
        height = obstacles + below + 0.7 * style.carry_clearance
        return self._toward(view, goal, mat, CLOSE, lateral_ramp(pos[2], min(height, high), 0.0, 0.05))

    def _release(self, view: StateView) -> np.ndarray:
        pose = self._hold_pose
        if self._steps <= self.style.pause:
            return self._toward(view, pose.pos, pose.mat, CLOSE)
        if self._steps > 14:
            if evaluate(self.atom, view):
                self._enter("rest")
            else:
                self._retry()
        return self._toward(view, pose.pos, pose.mat, OPEN)

    def _grasp_pose(self, view: StateView, style: MotionStyle) -> Pose:
        """Return the pose of the grip site at the grasp, which follows small motions of the object.

        Raises:
            GraspError: No grasp is feasible.
        """
        now = pose_of(view, self._object)
        if self._plan is None or has_moved(self._plan[2], now):
            cloud = self.shapes.cloud(view, self._object)
            obstacles = self.shapes.obstacles(view, self._object)
            surface, axis = view.scene.workspace.surface_height, finger_axis(view.eef_mat)
            self._plan = None
            self._plan = *choose_top_grasp(cloud, obstacles, surface, axis, self._object), now
            self._clear_height = cloud[:, 2].max() - self._plan[0][2] + GRIPPER.tip_below
        pos, yaw, then = self._plan
        along = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * style.grasp_shift
        mat = downward(yaw + style.yaw_error, finger_axis(view.eef_mat))
        return Pose(pos + now.pos - then.pos + along, mat)
