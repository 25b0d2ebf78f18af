"""Kernels for the truth of conditions, such as that a body is in a box or that two entities touch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from libero_env.sim.mjwarp.simulations import WarpSimulations
from libero_env.sim.predicates import ON_XY_DISTANCE, UP_HEIGHT
from libero_env.sim.regions import BOX_BELOW, ON_ABOVE, ON_BELOW
from libero_env.sim.scene import Scene

wp.set_module_options({"enable_backward": False})

TOUCH, STACKED, OVER, INSIDE, HIGH, JOINT_ABOVE, JOINT_BELOW = (wp.constant(kind) for kind in range(7))
NEAR, HEIGHT = wp.constant(wp.float64(ON_XY_DISTANCE)), wp.constant(wp.float64(UP_HEIGHT))
BELOW_BOX = wp.constant(wp.float64(BOX_BELOW))
BELOW_TOP, ABOVE_TOP = wp.constant(wp.float64(ON_BELOW)), wp.constant(wp.float64(ON_ABOVE))
ZERO = wp.constant(wp.float64(0.0))


@dataclass(frozen=True)
class Condition:
    """What a kernel evaluates in each simulation.

    Attributes:
        kind: `TOUCH`, `STACKED`, ...
        first: Body, or the address of a joint's position.
        second: Body below, or the site whose box it is; -1 for a box that is fixed.
        bound: Centre of a fixed box (3,), or the bound of a joint, -, -, and half of the box's edges (3,).
        pair: Names of the entities that touch.
    """

    kind: int
    first: int = -1
    second: int = -1
    bound: tuple[float, ...] = (0.0,) * 6
    pair: tuple[str, str] | None = None


@wp.func
def _over(mat: wp.mat33d, offset: wp.vec3d, half: wp.vec3d):
    """Return whether a point is on top of a box, see `libero_env.sim.regions.is_over`."""
    delta = mat * offset
    high = half[2] - BELOW_TOP < delta[2] and delta[2] < half[2] + ABOVE_TOP
    return high and wp.abs(delta[0]) < half[0] and wp.abs(delta[1]) < half[1]


@wp.func
def _inside(mat: wp.mat33d, centre: wp.vec3d, half: wp.vec3d, point: wp.vec3d):
    """Return whether a point is in a box, see `libero_env.sim.regions.contains`."""
    turned = mat * half
    inside = True
    for r in range(3):
        low = centre[r] - wp.abs(turned[r])
        if r == 2:
            low = low - BELOW_BOX
        inside = inside and point[r] > low and point[r] < centre[r] + wp.abs(turned[r])
    return inside


@wp.kernel
def find_truths(
    kinds: wp.array[int],
    firsts: wp.array[int],
    seconds: wp.array[int],
    bounds: wp.array2d[wp.float64],
    qpos: wp.array2d[float],
    xpos: wp.array2d[wp.vec3],
    site_xpos: wp.array2d[wp.vec3],
    site_xmat: wp.array2d[wp.mat33],
    truths: wp.array2d[wp.uint8],
):
    """Evaluate all conditions but contacts in every simulation."""
    i, k = wp.tid()
    kind = kinds[k]
    first = firsts[k]
    second = seconds[k]
    truth = False
    if kind == JOINT_ABOVE:
        truth = wp.float64(qpos[i, first]) > bounds[k, 0]
    elif kind == JOINT_BELOW:
        truth = wp.float64(qpos[i, first]) < bounds[k, 0]
    elif kind == HIGH:
        truth = wp.float64(xpos[i, first][2]) >= HEIGHT
    elif kind == STACKED:
        offset = wp.vec3d(xpos[i, first]) - wp.vec3d(xpos[i, second])
        truth = offset[2] >= ZERO and wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]) < NEAR
    elif kind != TOUCH:
        centre = wp.vec3d(bounds[k, 0], bounds[k, 1], bounds[k, 2])
        half = wp.vec3d(bounds[k, 3], bounds[k, 4], bounds[k, 5])
        mat = wp.identity(3, dtype=wp.float64)
        if second >= 0:
            centre = wp.vec3d(site_xpos[i, second])
            mat = wp.mat33d(site_xmat[i, second])
        point = wp.vec3d(xpos[i, first])
        if kind == OVER:
            truth = _over(mat, point - centre, half)
        else:
            truth = _inside(mat, centre, half, point)
    if truth:
        truths[i, k] = wp.uint8(1)
    else:
        truths[i, k] = wp.uint8(0)


@wp.kernel
def find_contacts(
    kinds: wp.array[int],
    sides: wp.array3d[wp.uint8],
    ncontact: wp.array[int],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    geom_body: wp.array[int],
    truths: wp.array2d[wp.uint8],
):
    """Set the truth of each condition of contact that a contact makes true."""
    c = wp.tid()
    if c >= ncontact[0]:
        return
    a = geom_body[geom[c][0]]
    b = geom_body[geom[c][1]]
    for k in range(kinds.shape[0]):
        if kinds[k] == TOUCH:
            one = int(sides[k, 0, a]) * int(sides[k, 1, b])
            other = int(sides[k, 0, b]) * int(sides[k, 1, a])
            if one + other > 0:
                truths[world[c], k] = wp.uint8(1)


class Conditions:
    """Conditions on the device."""

    def __init__(self, simulations: WarpSimulations, scene: Scene, conditions: Sequence[Condition]):
        self._simulations, self._count = simulations, len(conditions)
        sides = np.zeros((len(conditions), 2, scene.model.nbody), np.uint8)
        for k, one in enumerate(conditions):
            for side, name in enumerate(one.pair or ()):
                sides[k, side, scene.bodies[name]] = 1
        with wp.ScopedDevice(simulations.device):
            self._kinds = wp.array([c.kind for c in conditions], dtype=int)
            self._firsts = wp.array([c.first for c in conditions], dtype=int)
            self._seconds = wp.array([c.second for c in conditions], dtype=int)
            bounds = np.array([c.bound for c in conditions], np.float64).reshape(-1, 6)
            self._bounds, self._sides = wp.array(bounds, dtype=wp.float64), wp.array(sides, dtype=wp.uint8)
            self._truths = wp.zeros((simulations.num, len(conditions)), dtype=wp.uint8)

    def truths(self) -> np.ndarray:
        """Return the truth of each condition in each simulation, (num, n) bool."""
        simulations = self._simulations
        if not self._count:
            return np.zeros((simulations.num, 0), bool)
        model, data = simulations.device_model, simulations.device_data
        with wp.ScopedDevice(simulations.device):
            wp.launch(
                find_truths,
                (simulations.num, self._count),
                inputs=[self._kinds, self._firsts, self._seconds, self._bounds],
                outputs=[data.qpos, data.xpos, data.site_xpos, data.site_xmat, self._truths],
            )
            wp.launch(
                find_contacts,
                data.naconmax,
                inputs=[self._kinds, self._sides, data.nacon, data.contact.geom, data.contact.worldid],
                outputs=[model.geom_bodyid, self._truths],
            )
        return self._truths.numpy().astype(bool)
