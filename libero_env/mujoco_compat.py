"""MuJoCo, which every module imports from here: differences between its versions, and where its warnings go."""

import logging
import os
import re
import sys
from typing import Any

import numpy as np


def forget_opengl(platform: str | None) -> None:
    """Undo what an OpenGL backend that failed has left behind.

    Args:
        platform: Value of `PYOPENGL_PLATFORM` before, None for none: PyOpenGL keeps that of its first import.
    """
    os.environ.pop("PYOPENGL_PLATFORM", None)
    if platform is not None:
        os.environ["PYOPENGL_PLATFORM"] = platform
    for module in list(sys.modules):
        if re.match(r"OpenGL(\.|$)|mujoco\.(egl|osmesa|gl_context|rendering|renderer)", module):
            del sys.modules[module]


# MuJoCo loads the backend that MUJOCO_GL names when it is imported. Where that fails, only drawing is an error, that of
# `libero_env.sim.render`.
_named, _platform = os.environ.get("MUJOCO_GL"), os.environ.get("PYOPENGL_PLATFORM")
try:
    import mujoco
except Exception as error:  # noqa: BLE001 - each backend fails in its own way (ImportError, AttributeError, RuntimeError)
    if not _named or (isinstance(error, ModuleNotFoundError) and error.name == "mujoco"):
        raise
    forget_opengl(_platform)
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    finally:
        os.environ["MUJOCO_GL"] = _named

_warned: set[str] = set()


def log_warnings() -> None:
    """Pass MuJoCo's warnings to the logger `libero_env.mujoco`, each kind once, unless a user receives them already.

    By default MuJoCo writes them to the file MUJOCO_LOG.TXT in the working directory.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log_warning)


def _log_warning(text: str) -> None:
    """Log a warning; MuJoCo calls it from any thread, and an exception would end the process."""
    kind = re.sub(r"[-+]?\d+(\.\d+)?|nan|inf", "N", text)
    if kind not in _warned:
        _warned.add(kind)
        logging.getLogger("libero_env.mujoco").warning("MuJoCo: %s", " ".join(text.split()))


def delete(spec: mujoco.MjSpec, element: Any) -> None:
    """Remove an element from a spec; before MuJoCo 3.4 it is a method of the element."""
    if hasattr(spec, "delete"):
        spec.delete(element)
    else:
        element.delete()


def set_damping(joint: mujoco.MjsJoint, damping: float) -> None:
    """Set the linear damping of a joint: a number in MuJoCo 3, the first coefficient of a polynomial in 4."""
    if np.ndim(joint.damping):
        joint.damping[0] = damping
    else:
        joint.damping = damping


def make_directional(light: mujoco.MjsLight) -> None:
    """Let a light shine in one direction everywhere."""
    if hasattr(mujoco, "mjtLightType"):
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    else:  # before MuJoCo 3.4
        light.directional = True


# Sparse mass matrix in MjData: rows of the lower triangle; before MuJoCo 3.3.3 for each joint its chain to the root.
MASS_FIELD = "M" if hasattr(mujoco.MjModel, "M_rowadr") else "qM"

# Before MuJoCo 3.3.6 mj_forward, too, replaces the solver's warm start: calling it before a step changes the step.
FORWARD_WARM_STARTS = tuple(int(part) for part in mujoco.__version__.split(".")[:3]) < (3, 3, 6)
