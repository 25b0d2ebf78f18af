"""Control laws of joint positions and joint velocities, compiled; one kernel for one or many simulations.

Gains are those of robosuite 1.4.
"""

import numpy as np

from libero_env.parallel import compiled
from libero_env.sim.osc import move_gripper

VELOCITY_WINDOW = 5  # substeps over which the derivative is averaged
VELOCITY_MEMORY = (
    7 * VELOCITY_WINDOW + 7 + 2
)  # errors of the window, their sum, saturated, number of substeps
_KP = 50.0
_KD = 2.0 * np.sqrt(50.0)
_VELOCITY_KP = 3.0  # of the width of the torque range, per rad/s
_INTEGRAL, _DERIVATIVE = 0.005, 0.001  # of the proportional gain


@compiled
def joint_position_torques(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest,
):  # fmt: skip
    """Compute one substep of control of joint positions: tau = M (kp (goal - q) - kd qd) + bias.

    Arguments as in `libero_env.sim.osc.osc_torques`; goal (n, 7), rad.
    """
    pull = np.empty(7)
    for k in range(ids.shape[0]):
        i = ids[k]
        for j in range(7):
            pull[j] = _KP * (goal[i, j] - qpos[i, j]) - _KD * qvel[i, j]
        for j in range(7):
            tau = bias[i, j]
            for c in range(7):
                tau += mass[i, mass_address[j, c]] * pull[c]
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
        move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)


@compiled
def joint_velocity_torques(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest,
):  # fmt: skip
    """Compute one substep of a PID loop on joint velocities, plus bias.

    The integral is not updated while a torque saturates. The derivative is the change of the error over the window,
    divided by the number of substeps in it.

    Arguments as in `libero_env.sim.osc.osc_torques`; goal (n, 7), rad/s; memory (n, 44): errors of the window, oldest
    first, their sum, whether a torque saturated, number of substeps.
    """
    total, flag, count = 7 * VELOCITY_WINDOW, 7 * VELOCITY_WINDOW + 7, 7 * VELOCITY_WINDOW + 8
    for k in range(ids.shape[0]):
        i = ids[k]
        memory[i, count] = min(memory[i, count] + 1.0, float(VELOCITY_WINDOW))
        saturated = False
        for j in range(7):
            error = goal[i, j] - qvel[i, j]
            change = (error - memory[i, j]) / memory[i, count]
            for w in range(VELOCITY_WINDOW - 1):
                memory[i, 7 * w + j] = memory[i, 7 * w + 7 + j]
            memory[i, 7 * (VELOCITY_WINDOW - 1) + j] = error
            if memory[i, flag] == 0.0:
                memory[i, total + j] += error
            gain = _VELOCITY_KP * 2.0 * torque_limit[j]
            tau = bias[i, j] + gain * (error + _INTEGRAL * memory[i, total + j] + _DERIVATIVE * change)
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
            saturated = saturated or ctrl[i, j] != tau
        memory[i, flag] = 1.0 if saturated else 0.0
        move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)
