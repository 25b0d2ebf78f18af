"""The arm and its gripper: dimensions, inverse kinematics, posture costs in closed form, servo control."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from libero_env.assets.robot import REST_QPOS
from libero_env.geometry import Pose, rotation_between
from libero_env.mujoco_compat import mujoco
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE
from libero_env.sim.state import StateView

_GRIP_SITE = "gripper0_grip_site"
_MAX_STEPS, _STEP_SIZE, _REST_GAIN = 60, 0.5, 0.03
_DAMPING = 1e-3 * np.eye(6)
_MIN_STEP = 1e-3  # [rad] of every joint, below which the search stops
_POS_TOLERANCE, _ROT_TOLERANCE = 0.006, 0.06  # [m], [rad] that count as reached
_JOINT_MARGIN = 0.2  # [rad] from the limits of the joints, which the controller hits on the way
_ELBOW_RANGE = -2.85, -0.9  # [rad] of joint 4: short of folded, short of straight (-0.47), where it locks
_ROLL_JOINTS, _MAX_ROLL = [0, 2, 4], 1.0  # joints that roll the arm; [rad] of roll that is free of cost

_STRAIGHT_ELBOW = -0.467  # [rad] of joint 4
_LIMITED_BEND = 0.6  # [rad] from straight, below which the elbow's extension is limited
_LINK_FACTOR = 0.0892  # [m] a b / (2 (a + b)) for links of lengths a and b
_RESERVE = 0.012  # [m] of the remaining reach that is not used
# Franka Emika Panda, from its data sheet; the hand reaches from the flange to the grip site.
_SHOULDER = np.array([0.0, 0.0, 0.333])  # [m] above the base
_UPPER_ARM, _FOREARM, _ELBOW_OFFSET, _WRIST_OFFSET, _HAND = 0.316, 0.384, 0.0825, 0.088, 0.2104  # [m]
_COMFORTABLE_REACH = 0.32, 0.64  # [m] shoulder to wrist; joint limits of the elbow allow 0.20 to 0.70
_CENTRED_WRIST_YAW = 2.33  # [rad] yaw of the fingers, straight ahead of the arm, at which joint 7 is centred
_COMFORTABLE_BEND = 2.75  # [rad] of joint 6; at pi the axes of joints 5 and 7 coincide
OPEN, CLOSE = -1.0, 1.0  # gripper entry of an action
DAMPING_TIME = 0.12  # [s] of motion that is anticipated
ROTATION_GAIN = 2.5  # action per full-scale rotation error
MAX_ROTATION = 0.6  # largest norm of the rotation part of an action


@dataclass(frozen=True)
class PandaGripper:
    """Dimensions of the Franka hand and its fingers, [m].

    The frame is that of the grip site between the fingertips: x is the direction in which the fingers open, y lies
    across them, z points from the palm to the fingertips. "Below" is towards the fingertips.

    Attributes:
        max_opening: Distance between the fingertips of the open gripper.
        max_grasp_width: Largest width that is grasped: it leaves room for errors on both sides.
        pad_below: Reach of the finger pads below the grip site.
        pad_above: Reach of the finger pads above the grip site.
        tip_below: Reach of the fingertips below the grip site.
        palm_above: Height of the palm above the grip site, with 1.5 mm to spare.
        finger_half_width: Half the width of a finger, along y.
        finger_thickness: Largest thickness of a finger, along x.
        tip_thickness: Thickness of a finger at its tip, along x.
        finger_taper: Thickness that a finger gains for each metre above its tip, [m/m].
        palm_half_length: Half the extent of the hand along x.
        palm_half_width: Half the extent of the hand along y.
        hand_length: Extent of hand and wrist above the grip site.
    """

    max_opening: float = 0.08
    max_grasp_width: float = 0.072
    pad_below: float = 0.004
    pad_above: float = 0.012
    tip_below: float = 0.0095
    palm_above: float = 0.0285
    finger_half_width: float = 0.011
    finger_thickness: float = 0.0265
    tip_thickness: float = 0.0145
    finger_taper: float = 0.41
    palm_half_length: float = 0.105
    palm_half_width: float = 0.035
    hand_length: float = 0.28

    @property
    def half_opening(self) -> float:
        """Distance of an open finger from the middle, [m]."""
        return 0.5 * self.max_opening


GRIPPER = PandaGripper()


def limit_elbow_extension(view: StateView, action: np.ndarray) -> np.ndarray:
    """Return an action (7,) without what would straighten the elbow, and with some bending where it is nearly straight.

    The remaining reach of links a and b that are an angle d short of straight is a b d^2 / (2 (a + b)).
    """
    fields, i, model = view.simulations.fields, view.index, view.scene.model
    bend = _STRAIGHT_ELBOW - float(fields["qpos"][i][model.joint("robot0_joint4").qposadr[0]])
    if not 0.0 < bend < _LIMITED_BEND:
        return action
    shoulder, wrist = (fields["xpos"][i][model.body(f"robot0_link{k}").id] for k in (2, 6))
    outward = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    remaining = max(_LINK_FACTOR * bend**2 - _RESERVE, -_RESERVE)
    excess = max(float(action[:3] @ outward) * POSITION_SCALE - remaining, 0.0)
    return np.concatenate([np.clip(action[:3] - excess / POSITION_SCALE * outward, -1.0, 1.0), action[3:]])


def joint_angles(view: StateView) -> np.ndarray:
    """Return the seven joint angles of the arm, (7,), [rad]."""
    return view.simulations.fields["qpos"][view.index][:7]


class ArmKinematics:
    """Inverse kinematics that prefers the rest posture, as the controller does."""

    def __init__(self, model: mujoco.MjModel):
        self._model, self._data = model, mujoco.MjData(model)
        self._site = model.site(_GRIP_SITE).id
        joints = [model.joint(f"robot0_joint{k}") for k in range(1, 8)]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        ranges = np.array([joint.range for joint in joints])
        self._low, self._high = ranges.T + [[_JOINT_MARGIN], [-_JOINT_MARGIN]]
        self._low[3], self._high[3] = _ELBOW_RANGE

    def follow(self, start: np.ndarray, poses: Sequence[Pose]) -> tuple[np.ndarray, float]:
        """Solve for poses of the grip site one after the other, each from the solution before.

        Args:
            start: Joint angles at the start, (7,), [rad].

        Returns:
            The last joint angles, and the largest error of the poses: 0 where all are reached.
        """
        angles, largest = start, 0.0
        for pose in poses:
            angles, error = self.solve(angles, pose)
            largest = max(largest, error)
        return angles, largest

    def solve(self, start: np.ndarray, pose: Pose) -> tuple[np.ndarray, float]:
        """Solve for one pose of the grip site.

        Args:
            start: Joint angles at the start, (7,), [rad].

        Returns:
            Joint angles (7,), [rad], and the error beyond the tolerances, [m]; 0.1 rad of orientation count as 1 cm.
        """
        model, data, angles = self._model, self._data, start.copy()
        jacobian, rest = np.zeros((6, model.nv)), np.array(REST_QPOS)
        for _ in range(_MAX_STEPS):
            data.qpos[self._qpos] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            move = pose.pos - data.site_xpos[self._site]
            turn = rotation_between(data.site_xmat[self._site].reshape(3, 3), pose.mat)
            if move @ move < (0.3 * _POS_TOLERANCE) ** 2 and turn @ turn < (0.3 * _ROT_TOLERANCE) ** 2:
                break
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._site)
            arm_jacobian = jacobian[:, self._dof]
            to_rest = _REST_GAIN * (rest - angles)
            task = np.concatenate([move, turn]) - arm_jacobian @ to_rest
            inner = np.linalg.solve(arm_jacobian @ arm_jacobian.T + _DAMPING, task)
            step = np.minimum(np.maximum(arm_jacobian.T @ inner + to_rest, -0.5), 0.5)
            before, angles = angles, np.minimum(np.maximum(angles + _STEP_SIZE * step, self._low), self._high)
            if np.abs(angles - before).max() < _MIN_STEP:
                break
        error = max(float(np.linalg.norm(move)) - _POS_TOLERANCE, 0.0)
        error = error + 0.1 * max(float(np.linalg.norm(turn)) - _ROT_TOLERANCE, 0.0)
        roll = np.abs(angles - start)[_ROLL_JOINTS].max()
        return angles, float(error + 0.02 * max(roll - _MAX_ROLL, 0.0))


def posture_cost(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the cost of the arm's posture: twisted and bent-back wrists, folded and stretched elbows.

    Args:
        pos: Positions of the grip site in the world frame, (N, 3), [m].
        mat: Orientations of the grip site, (N, 3, 3).
        base: Position of the robot's base, (3,), [m].

    Returns:
        Costs (N,): 0 for a comfortable posture, about 1 where a joint is at its limit.
    """
    bent_back = np.maximum(wrist_bend(pos, mat, base) - _COMFORTABLE_BEND, 0.0)
    return 0.12 * wrist_twist(pos, mat, base) ** 2 + 20.0 * reach_violation(pos, mat, base) + 1.5 * bent_back


def wrist_twist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the angles between hands and the orientation in which the wrist's joints are centred, (N,), [rad]."""
    yaw = _CENTRED_WRIST_YAW + np.arctan2(pos[:, 1] - base[1], pos[:, 0] - base[0])
    c, s = np.cos(yaw), np.sin(yaw)
    trace = c * (mat[:, 0, 0] - mat[:, 1, 1]) + s * (mat[:, 1, 0] + mat[:, 0, 1]) - mat[:, 2, 2]
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def reach_violation(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return how far wrists are outside the comfortable reach, too close or too far, (N,), [m]."""
    distance = np.linalg.norm(_wrist(pos, mat, base), axis=1)
    return np.maximum(0.0, np.maximum(distance - _COMFORTABLE_REACH[1], _COMFORTABLE_REACH[0] - distance))


def wrist_bend(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the angle of joint 6 with the elbow straight above the line from shoulder to wrist, (N,), [rad].

    At pi the hand points along the forearm and the wrist is singular; the joint's limit is 3.75.
    """
    approach = mat[:, :, 2]
    wrist = _wrist(pos, mat, base)
    ahead, level = _unit(wrist * [1.0, 1.0, 0.0]), np.hypot(wrist[:, 0], wrist[:, 1])
    upper, lower = np.hypot(_UPPER_ARM, _ELBOW_OFFSET), np.hypot(_FOREARM, _ELBOW_OFFSET)
    distance = np.linalg.norm(wrist, axis=1)
    cosine = (upper**2 + distance**2 - lower**2) / (2 * upper * np.maximum(distance, 1e-9))
    elbow = np.arctan2(level, wrist[:, 2]) - np.arccos(np.clip(cosine, -1, 1))  # angles from straight up
    forearm = np.arctan2(level - upper * np.sin(elbow), wrist[:, 2] - upper * np.cos(elbow))
    forearm = forearm + np.arctan2(_ELBOW_OFFSET, _FOREARM)
    forward = np.sum(approach * ahead, axis=1)
    return np.pi - np.arctan2(
        forward * np.cos(forearm) - approach[:, 2] * np.sin(forearm),
        forward * np.sin(forearm) + approach[:, 2] * np.cos(forearm),
    )


def _wrist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the intersection of the axes of joints 5 and 6, from the shoulder, (N, 3), [m].

    The plane of the arm is taken to be vertical.
    """
    approach = mat[:, :, 2]
    flange = pos - _HAND * approach - base - _SHOULDER
    ahead = _unit(flange * [1.0, 1.0, 0.0])
    return flange - _WRIST_OFFSET * _unit(ahead - np.sum(ahead * approach, axis=1)[:, None] * approach)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]


def action_toward(
    pos: np.ndarray,
    mat: np.ndarray,
    target_pos: np.ndarray,
    target_mat: np.ndarray,
    *,
    velocity: np.ndarray,
    gripper: float,
    gain: float = 1.6,
    speed: float = 1.0,
    lateral_scale: float = 1.0,
) -> np.ndarray:
    """Return a damped proportional action towards a pose of the grip site.

    Damping and the higher gain of the rotation compensate for the controller, which decouples position and
    orientation although the arm couples them: a hand that brakes tilts and recovers slowly. With both, 30 cm to within
    2.5 mm take 36 steps instead of 59.

    Args:
        pos: Position of the grip site in the world frame, (3,), [m].
        mat: Orientation of the grip site, site to world (3, 3).
        target_pos: Target position of the grip site, (3,), [m].
        target_mat: Target orientation of the grip site, (3, 3).
        velocity: Velocity of the grip site, (3,), [m/s].
        gripper: Seventh entry of the action: `OPEN`, `CLOSE` or 0 to keep the fingers where they are.
        gain: Action per full-scale position error.
        speed: Largest translation; both horizontal entries are scaled together, so that paths are straight.
        lateral_scale: Factor on the horizontal part, in [0, 1].

    Returns:
        Action (7,) in [-1, 1].
    """
    action = np.zeros(7)
    move = gain * (target_pos - pos - DAMPING_TIME * velocity) / POSITION_SCALE
    action[:2] = lateral_scale * move[:2] * min(1.0, speed / max(np.abs(move[:2]).max(), 1e-9))
    action[2] = np.clip(move[2], -speed, speed)
    turn = ROTATION_GAIN * rotation_between(mat, target_mat) / ROTATION_SCALE
    action[3:6] = turn * min(1.0, MAX_ROTATION / max(float(np.linalg.norm(turn)), 1e-9))
    action[6] = gripper
    return action


def lateral_ramp(height: float, target_height: float, tolerance: float, band: float) -> float:
    """Return the factor on horizontal motion, in [0, 1], of a hand that has to rise first.

    Args:
        height: Height of the grip site, [m].
        target_height: Height to which it rises, [m].
        tolerance: Missing height up to which the hand moves at full speed, [m].
        band: Missing height beyond the tolerance over which the speed falls to zero, [m].
    """
    return float(np.clip(1.0 - (target_height - height - tolerance) / band, 0.0, 1.0))


def finger_axis(mat: np.ndarray) -> np.ndarray:
    """Return the direction in which the fingers open, (3,), for an orientation of the grip site (3, 3)."""
    return mat[:, 0]


def downward(yaw: float, finger_axis: np.ndarray) -> np.ndarray:
    """Return the orientation (3, 3) of a gripper that points down with its fingers opening along `yaw`, [rad].

    Of the two that are half a turn apart, it is the one closer to `finger_axis` (3,), where the fingers open now.
    """
    x = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    if x @ finger_axis < 0:
        x = -x
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])
