"""What MuJoCo Warp's simulations have on the device, and how the host reads it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from libero_env.errors import LiberoError
from libero_env.mujoco_compat import MASS_FIELD, mujoco
from libero_env.sim.backend import Backend
from libero_env.sim.osc import ArmIndex
from libero_env.sim.simulation import FIELDS
from libero_env.warp import kernels

_log = logging.getLogger(__name__)


def choose_device(name: str | None) -> Any:
    """Return a device of Warp.

    Args:
        name: Name such as `cpu` or `cuda:1`; None for the first GPU, or the processor where there is none.

    Raises:
        LiberoError: There is no such device here.
    """
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING  # a line for each kernel otherwise
    wp.init()
    if name is None:
        name = "cuda:0" if wp.is_cuda_available() else "cpu"
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        here = ", ".join(str(device) for device in wp.get_devices())
        raise LiberoError(f"backend=warp: there is no device {name!r}; here are: {here}") from error


def can_capture(device: Any) -> bool:
    """Return whether a control step can be one graph: on a GPU that needs memory pools, and CUDA 12.4 for its loop."""
    if not device.is_cuda:
        return True
    if not wp.is_mempool_enabled(device):
        lack = "memory pools"
    elif not wp.is_conditional_graph_supported():
        lack = "a driver for CUDA 12.4 or newer"
    else:
        return True
    _log.warning(
        "backend=warp: kernels are launched one by one, which is slower: %s has not %s", device, lack
    )
    return False


def allocate(model: mujoco.MjModel, arm: ArmIndex, num: int, bodies: np.ndarray) -> Any:
    """Return the arrays of `kernels.Control` on the present device.

    Args:
        model: Model that is simulated.
        num: Number of simulations.
        bodies: Indices of the fixed bodies whose pose differs between simulations.
    """
    fixed = (model.body_weldid == 0) & np.isin(model.body_rootid, bodies)
    values = {
        "mass_address": wp.array(arm.mass_address.astype(np.int32)),
        "torque_limit": wp.array(arm.torque_limit.astype(np.float64)),
        "finger_range": wp.array(arm.finger_range.astype(np.float64)),
        "static_geoms": wp.array(np.flatnonzero(fixed[model.geom_bodyid]).astype(np.int32)),
        "site": arm.site,
        "active": wp.zeros(num, dtype=wp.bool),
        "rest": wp.zeros(7, dtype=wp.float64),
        "grip": wp.zeros(num, dtype=wp.float64),
        "time": wp.zeros(num),
    }
    double = {"goal_pos": 3, "goal_mat": 9, "gripper": 2, "arm": 7}
    single = {"qpos": model.nq, "qvel": model.nv, "warm_start": model.nv}
    values |= {name: wp.zeros((num, size), dtype=wp.float64) for name, size in double.items()}
    values |= {name: wp.zeros((num, size)) for name, size in single.items()}
    control = kernels.Control()
    for name, value in values.items():
        setattr(control, name, value)
    return control


@contextmanager
def room_for(num: int, backend: Backend) -> Iterator[None]:
    """Say in one line where the device's memory does not suffice for so many simulations.

    Raises:
        LiberoError: It does not.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if "allocate" not in str(error) and not isinstance(error, MemoryError):
            raise
        raise LiberoError(
            f"backend={backend}: no room for {num} simulations ({error}); take fewer, smaller images, or "
            f"fewer contacts than {backend.contacts}"
        ) from error


class DeviceFields(dict[str, Any]):
    """Fields of all simulations on the host, in double precision; each is copied when it is first read after a step."""

    def __init__(self, data: Any, arm: Any):
        super().__init__()
        self._data, self._arm = data, arm

    def __missing__(self, name: str) -> np.ndarray:
        if name not in FIELDS:
            raise KeyError(name)
        values = getattr(self._data, "M" if name == MASS_FIELD else name).numpy().astype(np.float64)
        if name == "qpos":
            values[:, :7] = self._arm.numpy()
        self[name] = values.reshape(*values.shape[:2], 9) if name == "site_xmat" else values
        return self[name]
