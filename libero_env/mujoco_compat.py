"""What differs between versions of MuJoCo in editing a model."""

from typing import Any

import mujoco
import numpy as np


def delete(spec: mujoco.MjSpec, element: Any) -> None:
    """Take an element out of a spec; before MuJoCo 3.4 the element does it itself."""
    if hasattr(spec, "delete"):
        spec.delete(element)
    else:
        element.delete()


def set_damping(joint: mujoco.MjsJoint, damping: float) -> None:
    """Linear damping of a joint: a number in MuJoCo 3, the first coefficient of a polynomial in 4."""
    if np.ndim(joint.damping):
        joint.damping[0] = damping
    else:
        joint.damping = damping


# MjData's sparse mass matrix: rows of the lower triangle, or before MuJoCo 3.3.3 the way from each joint to the root.
MASS_FIELD = "M" if hasattr(mujoco.MjModel, "M_rowadr") else "qM"
