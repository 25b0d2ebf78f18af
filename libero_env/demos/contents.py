"""What a demonstration file holds: names, shapes, types, values and attributes, checked before they are used."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import h5py
import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.demos.hdf5 import (
    BrokenDemoError,
    check_dataset,
    damage_named,
    open_demo_file,
    read_array,
    read_attribute,
    read_attributes,
)
from libero_env.errors import DemoError
from libero_env.images import flip_rows
from libero_env.validation import validate

Pairing = Literal["aligned", "libero"]

LOW_DIM_KEYS = {"gripper_states": 2, "joint_states": 7, "ee_states": 6, "ee_pos": 3, "ee_ori": 3}
IMAGE_KEYS = ("agentview_rgb", "eye_in_hand_rgb")
IMAGE_KINDS = {"_rgb": "u", "_depth": "f", "_segmentation": "iu"}  # end of a key -> kinds of NumPy dtype
LIMITS = {"actions": 10.0, "expert_actions": 10.0, "robot_states": 100.0} | dict.fromkeys(LOW_DIM_KEYS, 100.0)
OTHER_LIMIT = 1e6  # largest value of states, rewards and other numbers
COUNTS = ("num_demos", "total", "num_failed_attempts")  # attributes that follow from the demonstrations
MAX_TEXT = 32 << 20  # [characters] of an attribute
_NAME = re.compile("demo_([0-9]{1,9})")
_TYPES = {"f": "float", "u": "unsigned integer", "i": "integer"}
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
    """Return all attributes of a demonstration, checked; `where` names it in error messages."""
    attributes = _checked(_DemoAttributes, read_attributes(group, where), f"{where}: attribute")
    if "fixtures" in attributes:
        poses, where = np.asarray(attributes["fixtures"]), f"{where}: attribute fixtures"
        if poses.ndim != 2 or poses.shape[1] != 7 or poses.dtype.kind != "f":
            raise BrokenDemoError(f"{where} is {poses.shape} {poses.dtype}; expected (n, 7) float")
        if fault := value_fault("fixtures", poses):
            raise BrokenDemoError(f"{where} {fault}")
        if (np.linalg.norm(poses[:, 3:], axis=1) < 1e-6).any():
            raise BrokenDemoError(f"{where} has a quaternion of zeros; expected (n, 7) pos and quat wxyz")
        attributes["fixtures"] = poses.astype(np.float64)
    return attributes


def _checked(kind: Any, attributes: dict[str, Any], source: str) -> dict[str, Any]:
    relied_on = {key: attributes[key] for key in kind.__annotations__ if key in attributes}
    validate(kind, relied_on, source=source, error=BrokenDemoError)
    return attributes


def json_attribute(header: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    """Return an attribute that holds JSON keys with values; empty where the file has none.

    Raises:
        BrokenDemoError: It holds something else.
    """
    try:
        values = json.loads(header.get(key) or "{}")
    except (ValueError, RecursionError) as error:
        raise BrokenDemoError(
            f"{file}: attribute {key} is not JSON ({error}); expected keys with values"
        ) from None
    if not isinstance(values, dict):
        raise BrokenDemoError(
            f"{file}: attribute {key} is {str(values)[:40]!r}; expected JSON keys with values"
        )
    return values


def demo_names(handle: h5py.File, file: Path) -> list[str]:
    """Return the names of the demonstrations in numerical order.

    Raises:
        BrokenDemoError: The file has no group `data`.
    """
    if not isinstance(handle.get("data"), h5py.Group):
        raise BrokenDemoError(
            f"{file}: key data is missing; expected a group of demonstrations demo_0, demo_1, ..."
        )
    names: dict[int, str] = {}
    for name in handle["data"]:
        if _NAME.fullmatch(name) is None:
            continue
        if (other := names.setdefault(demo_number(name), name)) != name:
            raise BrokenDemoError(
                f"{file}: {other} and {name} have the same number; expected each number once"
            )
    return [names[number] for number in sorted(names)]


def subset_names(handle: h5py.File, file: Path, key: str) -> list[str]:
    """Return the names of the demonstrations in a subset of a file, which robomimic keeps in the group `mask`.

    Raises:
        DemoError: There is no such subset.
        BrokenDemoError: It does not hold names of the file's demonstrations.
    """
    masks, valid = handle.get("mask"), demo_names(handle, file)
    if not isinstance(masks, h5py.Group) or not isinstance(masks.get(key), h5py.Dataset):
        subsets = ", ".join(masks) if isinstance(masks, h5py.Group) else ""
        raise DemoError(f"{file}: no subset {key!r} in mask; valid: {subsets or 'none'}")
    where = f"{file}: mask/{key}"
    check_dataset(masks[key], where)
    values = read_array(masks[key], where).ravel()
    names = [name.decode(errors="replace") if isinstance(name, bytes) else name for name in values]
    if unknown := [name for name in names if name not in valid]:
        raise BrokenDemoError(f"{where} names {unknown[0]!r}, which the file does not have")
    return names


def demo_number(name: str) -> int:
    """Return the number of a demonstration from its name: 3 from `demo_3`."""
    return int(name.removeprefix("demo_"))


def picture_size(handle: h5py.File, file: Path) -> tuple[int, int] | None:
    """Return height and width of the first colour images of a file; None where it has none."""
    for name in demo_names(handle, file)[:1]:
        group = handle["data"][name]
        obs = group.get("obs") if isinstance(group, h5py.Group) else None
        colours = [key for key in obs if key.endswith("_rgb")] if isinstance(obs, h5py.Group) else []
        if colours and isinstance(obs, h5py.Group):
            check_demo(group, f"{file}: {name}", colours)
            return int(obs[colours[0]].shape[1]), int(obs[colours[0]].shape[2])
    return None


def read_pairing(handle: h5py.File, file: Path) -> Pairing:
    """Return which observation stands with an action; the original's files, which do not state it, have "libero".

    Raises:
        BrokenDemoError: The file states something else.
    """
    stated = read_attribute(handle["data"], "pairing", f"{file}: data", "libero")
    return _checked(_Header, {"pairing": stated}, f"{file}: attribute")["pairing"]


def is_image(key: str) -> bool:
    """Return whether an observation is an image, which is stored upside down: `agentview_rgb` is, `ee_pos` is not."""
    return key.endswith(tuple(IMAGE_KINDS))


def check_demo(group: h5py.Group, where: str, obs_keys: Iterable[str]) -> int:
    """Check the keys, shapes, types and sizes of one demonstration without reading it.

    Args:
        group: The demonstration.
        where: File and name of the demonstration, for error messages.
        obs_keys: Observations to check.

    Returns:
        Number of bytes that it needs in memory.

    Raises:
        BrokenDemoError: The message names file, demonstration, key, and what was expected.
    """
    steps = count_steps(group, where)
    arrays: dict[str, tuple[tuple[int | None, ...], str]] = {
        "actions": ((steps, 7), "f"),
        "states": ((steps, None), "f"),
        "robot_states": ((steps, 9), "f"),
        "expert_actions": ((steps, 7), "f"),
        "rewards": ((steps,), "uif"),
        "dones": ((steps,), "uif"),
    }
    size = 0
    for key, (shape, kinds) in arrays.items():
        if key == "actions" or key in group:
            size += _check_array(_dataset(group, key, where), f"{where}/{key}", shape, kinds)
    for key in obs_keys:
        dataset, path = _dataset(group, f"obs/{key}", where), f"{where}/obs/{key}"
        if is_image(key):
            kinds = next(kinds for end, kinds in IMAGE_KINDS.items() if key.endswith(end))
            size += 2 * _check_array(dataset, path, _image_shape(key, steps, dataset.ndim), kinds)  # turned
        else:
            size += _check_array(dataset, path, (steps, LOW_DIM_KEYS.get(key)), "f")
    return size


def count_steps(group: h5py.Group, where: str) -> int:
    """Return the number of steps of a demonstration; BrokenDemoError if it has none."""
    if not isinstance(group, h5py.Group):
        raise BrokenDemoError(f"{where} is not a group; expected actions, states, obs/ in it")
    actions = _dataset(group, "actions", where)
    if not actions.shape or actions.shape[0] == 0:
        raise BrokenDemoError(f"{where}/actions is empty; expected (T, 7) with T > 0")
    return actions.shape[0]


def _image_shape(key: str, steps: int, ndim: int) -> tuple[int | None, ...]:
    """Return (T, H, W, 3) for colours and (T, H, W) for others, where the original has one more axis of length 1."""
    if key.endswith("_rgb"):
        return steps, None, None, 3
    return (steps, None, None, 1) if ndim == 4 else (steps, None, None)


def _dataset(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    dataset = group.get(key)
    if not isinstance(dataset, h5py.Dataset):
        parent = group.get("obs") if key.startswith("obs/") else group
        others = ", ".join(sorted(parent)) if isinstance(parent, h5py.Group) else "nothing"
        raise BrokenDemoError(f"{where}/{key} is missing; expected a dataset of that name beside: {others}")
    return dataset


def _check_array(dataset: h5py.Dataset, where: str, shape: tuple[int | None, ...], kinds: str) -> int:
    """Check the shape and the type of a dataset; return its number of bytes in memory."""
    with damage_named(where):
        stored, dtype = dataset.shape or (), dataset.dtype
    fits = len(stored) == len(shape) and all(b in (None, a) for a, b in zip(stored, shape, strict=True))
    bits = 8 if kinds == "u" else 64
    if not fits or dtype.kind not in kinds or 8 * dtype.itemsize > bits:
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        types = " or ".join(_TYPES[kind] for kind in kinds)
        raise BrokenDemoError(
            f"{where} is {dataset.shape} {dtype}; expected ({expected}) {types} of at most {bits} bits"
        )
    return check_dataset(dataset, where)


def value_fault(key: str, values: np.ndarray) -> str | None:
    """Return what is wrong with the values of an array of a demonstration, or None.

    Numbers are finite and not absurd: at most 10 in actions, whose real ones are in [-1, 1], at most 100 in readings of
    the arm (rad, m), at most a million in others.

    Args:
        key: Name of the array, such as `actions` or `ee_pos`.
        values: (T, ...).
    """
    if values.dtype.kind != "f":
        return None
    largest = LIMITS.get(key, OTHER_LIMIT)
    good = np.abs(values) <= largest  # false for NaN
    if good.all():
        return None
    place = tuple(int(i) for i in np.argwhere(~good)[0])
    value = values[place]
    if np.isfinite(value):
        return f"is {value:g} at step {place[0]}; expected at most {largest:g} in size"
    return (
        f"has values that are not finite: {value} at step {place[0]}; expected numbers of at most {largest:g}"
    )


def read_values(group: h5py.Group, key: str, where: str, *, check: bool = True) -> np.ndarray | None:
    """Return an array of a demonstration whose shape has been checked; images are upright.

    Args:
        group: The demonstration.
        key: Array, such as `actions` or `obs/ee_pos`.
        where: File and name of the demonstration, for error messages.
        check: Whether the values are checked, too; see `value_fault`.

    Returns:
        (T, ...); None where the demonstration does not have it.
    """
    if (dataset := group.get(key)) is None:
        return None
    where, name = f"{where}/{key}", key.removeprefix("obs/")
    values = read_array(dataset, where)
    if check and (fault := value_fault(name, values)):
        raise BrokenDemoError(f"{where} {fault}")
    if is_image(name):
        return np.ascontiguousarray(flip_rows(values, 1))
    return values


def demo_motion(file: Path, name: str) -> list[np.ndarray | None]:
    """Return states and actions, executed and intended, of a demonstration; None for what it does not have."""
    keys = ("states", "actions", "expert_actions")
    with open_demo_file(file) as handle:
        return [read_values(handle["data"][name], key, f"{file}: {name}") for key in keys]


def same_motion(one: Sequence[np.ndarray | None], other: Sequence[np.ndarray | None]) -> bool:
    """Return whether two demonstrations have the same states and actions, see `demo_motion`, to the bit."""
    return all(
        a is b if a is None or b is None else np.array_equal(a, b) for a, b in zip(one, other, strict=True)
    )


def reached_goal(group: h5py.Group, where: str, ends: Iterable[np.ndarray | None]) -> bool:
    """Return whether a demonstration reached its goal: what its attribute says, else how its rewards or dones end.

    Args:
        group: The demonstration.
        where: File and name, for error messages.
        ends: Rewards and dones, where it has them; the first decides.
    """
    stated = read_attribute(group, "success", where)
    if stated is None:  # an episode that failed may be done, too
        return next((bool(values[-1] > 0) for values in ends if values is not None), True)
    if not isinstance(stated, bool | int | np.bool_ | np.integer) or int(stated) not in (0, 1):
        raise BrokenDemoError(f"{where} attribute success is {stated!r}; expected true or false")
    return bool(stated)
