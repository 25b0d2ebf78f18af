"""What the arm can reach: the pose that the controller would end in, by inverse kinematics."""

import mujoco
import numpy as np

from libero_env.expert.motion import rotation_between
from libero_env.robot import REST_QPOS

_STEPS, _GAIN, _REST = 60, 0.5, 0.03
_DAMPED = 1e-3 * np.eye(6)
_STALLED = 1e-3  # rad, of a step that gets nowhere
_POS, _TURN = 0.006, 0.06  # m and rad, what counts as reached
_MARGIN = 0.08  # rad, kept from the limits of a joint
_STRAIGHT = -0.9  # rad, of the elbow: straight at -0.47, beyond which it folds over and does not come back
_FOLDED = -2.85  # rad, of the elbow folded up, short of its limit
_ROLLS, _SWING = (
    [0, 2, 4],
    1.0,
)  # joints that turn the arm about itself, and rad from which on they count as a miss
_SITE = "gripper0_grip_site"


class Arm:
    """Inverse kinematics that pulls towards the rest posture, as the controller does."""

    def __init__(self, model: mujoco.MjModel):
        self._model, self._data = model, mujoco.MjData(model)
        self._site = model.site(_SITE).id
        joints = [model.joint(f"robot0_joint{k}") for k in range(1, 8)]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._low, self._high = np.array([joint.range for joint in joints]).T + [[_MARGIN], [-_MARGIN]]
        self._low[3], self._high[3] = _FOLDED, _STRAIGHT

    def follow(
        self, start: np.ndarray, poses: list[tuple[np.ndarray, np.ndarray]]
    ) -> tuple[np.ndarray, float]:
        """Go through poses of the grip site one after the other.

        Args:
            start: the seven joint angles to start from, rad.
            poses: (position (3,), orientation (3, 3)) each.

        Returns:
            The last joint angles, and by how much the worst of the poses is missed: 0 where all are reached.
        """
        angles, worst = start, 0.0
        for pos, mat in poses:
            angles, miss = self.reach(angles, pos, mat)
            worst = max(worst, miss)
        return angles, worst

    def reach(self, start: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> tuple[np.ndarray, float]:
        """Joint angles (7,) near a pose, and by how much it is missed (m, and radians tenfold less)."""
        model, data, angles = self._model, self._data, start.copy()
        jac, rest = np.zeros((6, model.nv)), np.array(REST_QPOS)
        for _ in range(_STEPS):
            data.qpos[self._qpos] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            away = pos - data.site_xpos[self._site]
            turn = rotation_between(data.site_xmat[self._site].reshape(3, 3), mat)
            if away @ away < (0.3 * _POS) ** 2 and turn @ turn < (0.3 * _TURN) ** 2:
                break
            mujoco.mj_jacSite(model, data, jac[:3], jac[3:], self._site)
            own = jac[:, self._dof]
            back = _REST * (rest - angles)
            inner = np.linalg.solve(own @ own.T + _DAMPED, np.concatenate([away, turn]) - own @ back)
            step = np.minimum(np.maximum(own.T @ inner + back, -0.5), 0.5)
            before, angles = angles, np.minimum(np.maximum(angles + _GAIN * step, self._low), self._high)
            if np.abs(angles - before).max() < _STALLED:
                break
        miss = max(np.linalg.norm(away) - _POS, 0.0) + 0.1 * max(np.linalg.norm(turn) - _TURN, 0.0)
        swing = np.abs(angles - start)[_ROLLS].max()
        return angles, float(miss + 0.02 * max(swing - _SWING, 0.0))
