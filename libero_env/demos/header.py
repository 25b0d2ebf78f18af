"""What demonstration files state about themselves: attributes, checked before anything relies on them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import h5py
import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.demos.contents import Pairing, demo_names, value_fault
from libero_env.demos.hdf5 import BrokenDemoError, open_demo_file, read_attributes
from libero_env.validation import validate

COUNTS = ("num_demos", "total", "num_failed_attempts")  # attributes that follow from the demonstrations
MAX_TEXT = 32 << 20  # [characters] of an attribute
_Text = Annotated[str, Field(max_length=MAX_TEXT)]
_Count = Annotated[float, Field(ge=0, le=1e12)]


class _Header(TypedDict, total=False):
    """Attributes of a file that something relies on; others may be anything."""

    pairing: Pairing
    robot: Literal["libero", "robosuite-1.4.1"]
    drawing: Literal["fast", "faithful"]
    backend: Literal["mujoco", "warp"]
    bddl_file_name: _Text
    bddl_file_content: _Text
    problem_info: _Text
    env_args: _Text
    models: _Text
    generator: _Text
    perturb: _Text
    num_demos: _Count
    total: _Count
    num_failed_attempts: _Count


class _DemoAttributes(TypedDict, total=False):
    """Attributes of a demonstration that something relies on."""

    failed_attempts: Annotated[int, Field(ge=0)]
    model_file: _Text


def read_header(file: Path) -> dict[str, Any]:
    """Return the attributes of a file's group `data`, without those that count its demonstrations.

    Raises:
        DemoError: It is not a demonstration file, or an attribute is not what it should be.
    """
    with open_demo_file(file) as handle:
        demo_names(handle, file)
        header = file_attributes(handle, file)
    return {key: value for key, value in header.items() if key not in COUNTS}


def file_attributes(handle: h5py.File, file: Path) -> dict[str, Any]:
    """Return all attributes of a file's group `data`, checked."""
    return _checked(_Header, read_attributes(handle["data"], f"{file}: data"), f"{file}: attribute")


def demo_attributes(group: h5py.Group, where: str) -> dict[str, Any]:
    """Return all attributes of a demonstration, checked.

    Args:
        group: The demonstration.
        where: File and name, for error messages.
    """
    found = _checked(_DemoAttributes, read_attributes(group, where), f"{where}: attribute")
    if "fixtures" in found:
        poses = np.asarray(found["fixtures"])
        if poses.ndim != 2 or poses.shape[1] != 7 or poses.dtype.kind != "f":
            raise BrokenDemoError(
                f"{where}: attribute fixtures is {poses.shape} {poses.dtype}; expected (n, 7) float"
            )
        check_poses(poses, f"{where}: attribute fixtures")
        found["fixtures"] = poses.astype(np.float64)
    return found


def check_poses(poses: np.ndarray, where: str) -> None:
    """Raise BrokenDemoError unless poses (n, 7), pos and quat wxyz, are finite and have rotations."""
    if fault := value_fault("fixtures", poses):
        raise BrokenDemoError(f"{where} {fault}")
    if (np.linalg.norm(poses[:, 3:], axis=1) < 1e-6).any():
        raise BrokenDemoError(f"{where} has a quaternion of zeros; expected (n, 7) pos and quat wxyz")


def json_attribute(header: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    """Return an attribute that holds JSON keys with values; empty where the file has none.

    Raises:
        BrokenDemoError: It holds something else.
    """
    try:
        found = json.loads(header.get(key) or "{}")
    except (ValueError, RecursionError) as error:
        raise BrokenDemoError(
            f"{file}: attribute {key} is no JSON ({error}); expected keys with values"
        ) from None
    if not isinstance(found, dict):
        raise BrokenDemoError(
            f"{file}: attribute {key} is {str(found)[:40]!r}; expected JSON keys with values"
        )
    return found


def _checked(kind: Any, attributes: dict[str, Any], source: str) -> dict[str, Any]:
    known = {key: attributes[key] for key in kind.__annotations__ if key in attributes}
    validate(kind, known, source=source, error=BrokenDemoError)
    return attributes
