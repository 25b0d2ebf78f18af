"""Warp kernels of a control step: the controller, and simulations that are held or posed.

The controller is that of `libero_env.sim.osc`, whose formulas and constants these are; it computes in double precision
from MuJoCo Warp's single-precision fields, since inertias in the task space are badly conditioned.
"""

from typing import Any

import warp as wp

from libero_env.sim import osc

# loops stay loops: they compile in a second
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.types.vector(6, wp.float64)
vec7 = wp.types.vector(7, wp.float64)
mat66 = wp.types.matrix((6, 6), wp.float64)
mat67 = wp.types.matrix((6, 7), wp.float64)
mat77 = wp.types.matrix((7, 7), wp.float64)

KP, KD = wp.constant(wp.float64(osc.KP)), wp.constant(wp.float64(osc.KD))
NULL_KP, NULL_KD = wp.constant(wp.float64(osc.NULL_KP)), wp.constant(wp.float64(osc.NULL_KD))
SPEED = wp.constant(wp.float64(osc.GRIPPER_SPEED))
HALF, ONE = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-14))


@wp.func
def _factor(a: Any, n: int):
    """Return the lower Cholesky factor of the leading block (n, n) of a matrix."""
    for j in range(n):
        for k in range(j):
            a[j, j] = a[j, j] - a[j, k] * a[j, k]
        a[j, j] = wp.sqrt(wp.max(a[j, j], TINY))
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] = a[i, j] - a[i, k] * a[j, k]
            a[i, j] = a[i, j] / a[j, j]
    return a


@wp.func
def _substitute(a: Any, b: Any, n: int):
    """Solve l l^T x = b for the lower triangle l of a."""
    for i in range(n):
        for k in range(i):
            b[i] = b[i] - a[i, k] * b[k]
        b[i] = b[i] / a[i, i]
    for r in range(n):
        i = n - 1 - r
        for k in range(i + 1, n):
            b[i] = b[i] - a[k, i] * b[k]
        b[i] = b[i] / a[i, i]
    return b


@wp.func
def _block(a: Any, start: int):
    """Return the diagonal block (3, 3) of a matrix that begins at a row, in the corner of a matrix (6, 6)."""
    found = mat66()
    for r in range(3):
        for c in range(3):
            found[r, c] = a[start + r, start + c]
    return found


@wp.struct
class Control:
    """What the kernels take beside MuJoCo Warp's model and data.

    Attributes:
        active: Which simulations are to be stepped; the others are held.
        grip: Gripper action of each.
        goal_pos: Goal of the grip site's position, m.
        goal_mat: Goal of its orientation, (num, 9).
        gripper: Command of the fingers, (num, 2).
        arm: Joint positions of the arm in double precision: in single they drift by the rounding of each sum.
        qpos: As MuJoCo Warp's before the step; `qvel`, `warm_start` and `time` likewise.
        mass_address: See `libero_env.sim.osc.ArmIndex`; `torque_limit`, `finger_range` and `site` likewise.
        rest: Joints of the rest pose.
        static_geoms: Geoms that are fixed to the world and whose poses differ between simulations.
    """

    active: wp.array[wp.bool]
    grip: wp.array[wp.float64]
    goal_pos: wp.array2d[wp.float64]
    goal_mat: wp.array2d[wp.float64]
    gripper: wp.array2d[wp.float64]
    arm: wp.array2d[wp.float64]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    warm_start: wp.array2d[float]
    time: wp.array[float]
    mass_address: wp.array2d[int]
    torque_limit: wp.array[wp.float64]
    finger_range: wp.array2d[wp.float64]
    rest: wp.array[wp.float64]
    static_geoms: wp.array[int]
    site: int


@wp.kernel
def osc_substep(
    control: Control,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    xanchor: wp.array2d[wp.vec3],
    xaxis: wp.array2d[wp.vec3],
    site_xpos: wp.array2d[wp.vec3],
    site_xmat: wp.array2d[wp.mat33],
    mass: wp.array2d[float],
    bias: wp.array2d[float],
    ctrl: wp.array2d[float],
):
    """Compute one substep of control, as `libero_env.sim.osc.osc_torques`, in each active simulation."""
    i = wp.tid()
    if not control.active[i]:
        return
    here = wp.vec3d(site_xpos[i, control.site])
    turned = wp.mat33d(site_xmat[i, control.site])
    jac = mat67()
    m = mat77()
    pull = vec7()
    velocity = vec7()
    for j in range(7):
        axis = wp.vec3d(xaxis[i, j])
        lever = wp.cross(axis, here - wp.vec3d(xanchor[i, j]))
        velocity[j] = wp.float64(qvel[i, j])
        pull[j] = NULL_KP * (control.rest[j] - wp.float64(qpos[i, j])) - NULL_KD * velocity[j]
        for r in range(3):
            jac[r, j] = lever[r]
            jac[3 + r, j] = axis[r]
        for k in range(7):
            m[j, k] = wp.float64(mass[i, control.mass_address[j, k]])
    inertia_pull = m * pull
    factor = _factor(m, 7)
    full = mat66()
    for c in range(6):
        column = vec7()
        for j in range(7):
            column[j] = jac[c, j]
        column = _substitute(factor, column, 7)
        for r in range(6):
            value = wp.float64(0.0)
            for j in range(7):
                value += jac[r, j] * column[j]
            full[r, c] = value
    task_pull = jac * pull
    speed = jac * velocity
    force = vec6()
    torque = vec6()
    for r in range(3):
        force[r] = KP * (control.goal_pos[i, r] - here[r]) - KD * speed[r]
        a = (r + 1) % 3
        b = (r + 2) % 3
        error = wp.float64(0.0)  # half the sum of the cross products of columns
        for c in range(3):
            error += turned[a, c] * control.goal_mat[i, 3 * b + c]
            error -= turned[b, c] * control.goal_mat[i, 3 * a + c]
        torque[r] = KP * HALF * error - KD * speed[3 + r]
    force = _substitute(_factor(_block(full, 0), 3), force, 3)
    torque = _substitute(_factor(_block(full, 3), 3), torque, 3)
    task_pull = _substitute(_factor(full, 6), task_pull, 6)
    for j in range(7):
        tau = wp.float64(bias[i, j]) + inertia_pull[j]
        for r in range(3):
            tau += jac[r, j] * (force[r] - task_pull[r]) + jac[3 + r, j] * (torque[r] - task_pull[3 + r])
        ctrl[i, j] = float(wp.clamp(tau, -control.torque_limit[j], control.torque_limit[j]))
    turn = wp.float64(0.0)
    if control.grip[i] > wp.float64(0.0):
        turn = SPEED
    if control.grip[i] < wp.float64(0.0):
        turn = -SPEED
    for f in range(2):
        step = turn
        if f == 0:
            step = -turn
        control.gripper[i, f] = wp.clamp(control.gripper[i, f] + step, -ONE, ONE)
        low = control.finger_range[f, 0]
        high = control.finger_range[f, 1]
        ctrl[i, 7 + f] = float(HALF * (high + low) + HALF * (high - low) * control.gripper[i, f])


@wp.kernel
def finish_substep(
    control: Control,
    timestep: wp.float64,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warm_start: wp.array2d[float],
    time: wp.array[float],
):
    """Undo a step of the simulations that are not active, and add one to the arm's joint positions of the others."""
    i = wp.tid()
    if control.active[i]:
        for j in range(7):
            control.arm[i, j] = control.arm[i, j] + timestep * wp.float64(qvel[i, j])
    else:
        for j in range(qpos.shape[1]):
            qpos[i, j] = control.qpos[i, j]
        for j in range(qvel.shape[1]):
            qvel[i, j] = control.qvel[i, j]
            warm_start[i, j] = control.warm_start[i, j]
        time[i] = control.time[i]
    for j in range(7):
        qpos[i, j] = float(control.arm[i, j])


@wp.func
def _quat_multiply(a: wp.quat, b: wp.quat):
    """Return the product of quaternions whose first number is the real one."""
    return wp.quat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.kernel
def pose_static_geoms(
    control: Control,
    geom_body: wp.array[int],
    geom_pos: wp.array2d[wp.vec3],
    geom_quat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
):
    """Pose geoms that are fixed to the world, which MuJoCo Warp does when its data are made and never again."""
    i, k = wp.tid()
    g = control.static_geoms[k]
    body = geom_body[g]
    quat = xquat[i, body]
    offset = geom_pos[0, g]
    mat = wp.quat_to_matrix(wp.quat(quat[1], quat[2], quat[3], quat[0]))
    geom_xpos[i, g] = xpos[i, body] + mat * offset
    turned = _quat_multiply(quat, geom_quat[0, g])
    geom_xmat[i, g] = wp.quat_to_matrix(wp.quat(turned[1], turned[2], turned[3], turned[0]))
