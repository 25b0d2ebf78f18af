"""What the arm can reach: the pose that the controller would end in, by inverse kinematics."""

import mujoco
import numpy as np

from libero_env.assets.robot import REST_QPOS
from libero_env.geometry import rotation_between
from libero_env.sim.osc import POSITION_SCALE
from libero_env.sim.state import StateView

_STEPS, _GAIN, _REST = 60, 0.5, 0.03
_DAMPED = 1e-3 * np.eye(6)
_STALLED = 1e-3  # rad, of a step that gets nowhere
_POS, _TURN = 0.006, 0.06  # m and rad, what counts as reached
_MARGIN = 0.2  # rad, kept from the limits of a joint, which the controller runs into on the way
_FOLD, _WATCHED = -0.467, 0.6  # rad, of the straight elbow, and short of it where it is watched
_LINKS, _KEPT = 0.0892, 0.012  # m, a b / (2 (a + b)) of the links, and of the way out that is not used
_STRAIGHT = -0.9  # rad, of the elbow: straight at -0.47, beyond which it folds over and does not come back
_FOLDED = -2.85  # rad, of the elbow folded up, short of its limit
_ROLLS, _SWING = (
    [0, 2, 4],
    1.0,
)  # joints that turn the arm about itself, and rad from which on they count as a miss
_SITE = "gripper0_grip_site"


def limit_elbow_extension(view: StateView, action: np.ndarray) -> np.ndarray:
    """An action (7,) without what would straighten the elbow, and with a little of the opposite where it is nearly so.

    The way out that is left of bent links a and b, an angle d short of straight, is a b d^2 / (2 (a + b)).
    """
    fields, i, model = view.simulations.fields, view.index, view.scene.model
    short = _FOLD - float(fields["qpos"][i][model.joint("robot0_joint4").qposadr[0]])
    if not 0.0 < short < _WATCHED:
        return action
    shoulder, wrist = (fields["xpos"][i][model.body(f"robot0_link{k}").id] for k in (2, 6))
    out = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    left = max(_LINKS * short**2 - _KEPT, -_KEPT)
    beyond = max(float(action[:3] @ out) * POSITION_SCALE - left, 0.0)
    return np.concatenate([np.clip(action[:3] - beyond / POSITION_SCALE * out, -1.0, 1.0), action[3:]])


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
