r"""Operational-space control of the arm, compiled; one kernel for one or many simulations.

The law (Khatib, "A unified approach for motion and force control of robot manipulators: the operational space
formulation", IEEE J. Robotics and Automation 1987), position and orientation decoupled, with gravity compensation and
a null-space pull towards the rest pose:

    tau = J^T [Lambda_p (kp e_p - kd v); Lambda_o (kp e_o - kd w)] + bias + N^T M (kn (q_rest - q) - dn qd)

with Lambda_p^-1 = J_p M^-1 J_p^T, Lambda_o^-1 = J_o M^-1 J_o^T and N^T = I - J^T Lambda J M^-1.
"""

from dataclasses import dataclass

import numpy as np

from libero_env.assets.robot import ARM_JOINTS, FINGER_JOINTS, GRIP_SITE, REST_QPOS
from libero_env.compilation import compiled
from libero_env.mujoco_compat import MASS_FIELD, mujoco

POSITION_SCALE = 0.05  # [m] at full action
ROTATION_SCALE = 0.5  # [rad] at full action
GRIPPER_SPEED = 0.01  # change of the command, in [-1, 1], in each substep
KP = 150.0
KD = 2.0 * np.sqrt(150.0)
GAINS = np.array([[KP] * 6, [KD] * 6])
NULL_KP = 10.0
NULL_KD = 2.0 * np.sqrt(10.0)
REST = np.array(REST_QPOS)  # [rad]


def _mass_address(model: mujoco.MjModel) -> np.ndarray:
    """Return the index of each entry of the arm's block in the sparse mass matrix, (7, 7)."""
    address = np.zeros((7, 7), np.int64)
    for i in range(7):
        for j in range(i + 1):
            if MASS_FIELD == "M":
                row = slice(model.M_rowadr[i], model.M_rowadr[i] + model.M_rownnz[i])
                entry = row.start + int(np.flatnonzero(model.M_colind[row] == j)[0])
            else:
                entry = model.dof_Madr[i] + i - j
            address[i, j] = address[j, i] = entry
    return address


@dataclass(frozen=True)
class ArmIndex:
    """Indices of the arm in a model's arrays.

    Attributes:
        joints: Indices of the arm's joints, (7,).
        mass_address: Index of each entry of the arm's block in the sparse mass matrix, (7, 7).
        torque_limit: Largest torque of each joint, (7,), N m.
        fingers: Indices of the finger joints, (2,).
        finger_range: Control range of the finger actuators, (2, 2), m.
    """

    joints: np.ndarray
    mass_address: np.ndarray
    site: int
    torque_limit: np.ndarray
    fingers: np.ndarray
    finger_range: np.ndarray

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "ArmIndex":
        """Find the arm by the names of its joints; it must be the first kinematic chain of the model."""
        joints = np.array([model.joint(n).id for n in ARM_JOINTS], np.int64)
        comes_first = (joints == np.arange(7)).all() and (model.jnt_dofadr[:7] == joints).all()
        assert comes_first, "the arm comes first"
        address = _mass_address(model)
        fingers = np.array([model.joint(n).id for n in FINGER_JOINTS], np.int64)
        limit, finger_range = model.actuator_ctrlrange[:7, 1].copy(), model.actuator_ctrlrange[7:9].copy()
        return cls(joints, address, model.site(GRIP_SITE).id, limit, fingers, finger_range)


@compiled
def goals_from_deltas(ids, actions, qpos, site_pos, site_mat, goal_pos, goal_mat):
    """Set the goals to the current pose plus the scaled action; see `libero_env.sim.controller.Controller.set_goals`.

    Without a commanded rotation the goal orientation is kept.
    """
    for k in range(ids.shape[0]):
        i = ids[k]
        is_rotated = False
        w = np.empty(3)
        for j in range(3):
            goal_pos[i, j] = site_pos[i, j] + POSITION_SCALE * min(max(actions[i, j], -1.0), 1.0)
            w[j] = ROTATION_SCALE * min(max(actions[i, 3 + j], -1.0), 1.0)
            is_rotated = is_rotated or w[j] != 0.0
        if is_rotated:
            rotate(w, site_mat[i], goal_mat[i])


@compiled
def goals_from_poses(ids, poses, goal_pos, goal_mat):
    """Set the goals to positions and rotation vectors, (n, 6) -> (n, 3), (n, 9) in place."""
    identity = np.eye(3).ravel()
    for k in range(ids.shape[0]):
        i = ids[k]
        for j in range(3):
            goal_pos[i, j] = poses[i, j]
        if poses[i, 3] != 0.0 or poses[i, 4] != 0.0 or poses[i, 5] != 0.0:
            rotate(poses[i, 3:], identity, goal_mat[i])
        else:
            for j in range(9):
                goal_mat[i, j] = identity[j]


@compiled
def rotate(w, current, out):
    """Write exp([w]x) current to `out`; (3,), (9,) -> (9,).

    The rotation is rounded to single precision as robosuite does it (`quat2mat` in its `utils/transform_utils.py`): its
    goals differ from exact ones by 1e-7, which contact would amplify.
    """
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    q = np.empty(4, np.float32)  # wxyz
    q[0] = np.cos(angle / 2.0)
    norm = 0.0
    for i in range(3):  # the squares of the smallest numbers are 0
        q[1 + i] = w[i] / angle * np.sin(angle / 2.0) if angle > 0.0 else 0.0
    for i in range(4):
        norm += np.float64(q[i] * q[i])  # as BLAS sums single precision
    scale = np.sqrt(2.0 / np.float64(np.float32(norm)))
    for i in range(4):
        q[i] = q[i] * scale
    r = np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        r[i, i] = 1.0 - q[1 + j] * q[1 + j] - q[1 + k] * q[1 + k]
        r[i, j] = q[1 + i] * q[1 + j] - q[1 + k] * q[0]
        r[j, i] = q[1 + i] * q[1 + j] + q[1 + k] * q[0]
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = r[i, 0] * current[j] + r[i, 1] * current[3 + j] + r[i, 2] * current[6 + j]


@compiled
def _solve(a, b):
    """Solve a x = b by Cholesky decomposition; x replaces b, the factor replaces a (n, n), symmetric positive definite."""
    n = len(b)
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        a[j, j] = np.sqrt(max(a[j, j], 1e-14))
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]
    _substitute(a, b)


@compiled
def _substitute(a, b):
    """Solve l l^T x = b for the lower triangle l of a; x replaces b (n,)."""
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]


@compiled
def osc_torques(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal_pos, goal_mat, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest, gains,
):  # fmt: skip
    """Compute one substep of control for the simulations `ids`; torques and finger commands are written to ctrl.

    The leading axis of all state arrays is the simulation: actions (n, action_dim), qpos (n, nq), qvel (n, nv), xanchor
    and xaxis (n, njnt, 3), site_pos (n, 3), site_mat (n, 9), mass (n, nM), bias (n, nv), goal_pos (n, 3), goal_mat
    (n, 9), gripper (n, 2), ctrl (n, nu). The constants: mass_address (7, 7), torque_limit (7,), finger_range (2, 2),
    rest (7,), gains (2, 6) on errors of the pose and on velocities.
    """
    jac = np.empty((6, 7))
    m = np.empty((7, 7))
    mass_inv_jac = np.empty((6, 7))
    full = np.empty((6, 6))
    linear, angular = np.empty((3, 3)), np.empty((3, 3))
    force, torque = np.empty(3), np.empty(3)
    pull, task_pull = np.empty(7), np.empty(6)
    for k in range(ids.shape[0]):
        i = ids[k]
        # Geometric Jacobian of the grip site: hinge j moves it by axis x (site - anchor).
        for j in range(7):
            ax, ay, az = xaxis[i, j, 0], xaxis[i, j, 1], xaxis[i, j, 2]
            dx = site_pos[i, 0] - xanchor[i, j, 0]
            dy = site_pos[i, 1] - xanchor[i, j, 1]
            dz = site_pos[i, 2] - xanchor[i, j, 2]
            jac[0, j], jac[1, j], jac[2, j] = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
            jac[3, j], jac[4, j], jac[5, j] = ax, ay, az
            pull[j] = NULL_KP * (rest[j] - qpos[i, j]) - NULL_KD * qvel[i, j]
            for l in range(7):
                m[j, l] = mass[i, mass_address[j, l]]
        # Inverse operational inertias from M^-1 J^T, and the task-space part of the null-space pull.
        for r in range(6):
            for j in range(7):
                mass_inv_jac[r, j] = jac[r, j]
        _solve(m, mass_inv_jac[0])
        for r in range(1, 6):
            _substitute(m, mass_inv_jac[r])
        for r in range(6):
            task_pull[r] = 0.0
            for j in range(7):
                task_pull[r] += jac[r, j] * pull[j]
            for c in range(6):
                value = 0.0
                for j in range(7):
                    value += jac[r, j] * mass_inv_jac[c, j]
                full[r, c] = value
        for r in range(3):
            for c in range(3):
                linear[r, c], angular[r, c] = full[r, c], full[3 + r, 3 + c]
        # Errors of position and orientation; the latter is half the sum of column cross products.
        for r in range(3):
            v, w = 0.0, 0.0
            for j in range(7):
                v += jac[r, j] * qvel[i, j]
                w += jac[3 + r, j] * qvel[i, j]
            force[r] = gains[0, r] * (goal_pos[i, r] - site_pos[i, r]) - gains[1, r] * v
            a, b = (r + 1) % 3, (r + 2) % 3
            error = 0.0
            for c in range(3):
                error += (
                    site_mat[i, 3 * a + c] * goal_mat[i, 3 * b + c]
                    - site_mat[i, 3 * b + c] * goal_mat[i, 3 * a + c]
                )
            torque[r] = gains[0, 3 + r] * 0.5 * error - gains[1, 3 + r] * w
        _solve(linear, force)
        _solve(angular, torque)
        _solve(full, task_pull)
        for j in range(7):
            tau = bias[i, j]
            for l in range(7):
                tau += mass[i, mass_address[j, l]] * pull[l]
            for r in range(3):
                tau += jac[r, j] * (force[r] - task_pull[r]) + jac[3 + r, j] * (torque[r] - task_pull[3 + r])
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
        move_gripper(actions[i, actions.shape[1] - 1], gripper[i], ctrl[i], finger_range)


@compiled
def move_gripper(action, command, ctrl, finger_range):
    """Change the command of both fingers by one ramp step and scale it to the actuators; -1 opens, +1 closes."""
    for f in range(2):
        direction = -1.0 if f == 0 else 1.0
        step = GRIPPER_SPEED * direction * np.sign(action)
        command[f] = min(max(command[f] + step, -1.0), 1.0)
        low, high = finger_range[f]
        ctrl[7 + f] = 0.5 * (high + low) + 0.5 * (high - low) * command[f]
