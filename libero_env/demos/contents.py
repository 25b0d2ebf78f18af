"""What a demonstration file holds: names, shapes, types and values, checked before anything is learned from them."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

import h5py
import numpy as np

from libero_env.demos.hdf5 import (
    BrokenDemoError,
    check_dataset,
    damage_named,
    read_array,
    read_attribute,
)
from libero_env.errors import DemoError

Pairing = Literal["aligned", "libero"]

LOW_DIM_KEYS = {"gripper_states": 2, "joint_states": 7, "ee_states": 6, "ee_pos": 3, "ee_ori": 3}
IMAGE_KEYS = ("agentview_rgb", "eye_in_hand_rgb")
IMAGE_KINDS = {"_rgb": "u", "_depth": "f", "_segmentation": "iu"}  # end of a key -> kinds of NumPy dtype
LIMITS = {"actions": 10.0, "expert_actions": 10.0, "robot_states": 100.0} | dict.fromkeys(LOW_DIM_KEYS, 100.0)
OTHER_LIMIT = 1e6  # largest value of states, rewards and other numbers
_NAME = re.compile("demo_([0-9]{1,9})")


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
    masks, names = handle.get("mask"), demo_names(handle, file)
    if not isinstance(masks, h5py.Group) or not isinstance(masks.get(key), h5py.Dataset):
        known = ", ".join(masks) if isinstance(masks, h5py.Group) else ""
        raise DemoError(f"{file}: no subset {key!r} in mask; valid: {known or 'none'}")
    where = f"{file}: mask/{key}"
    check_dataset(masks[key], where)
    found = [
        name.decode() if isinstance(name, bytes) else name for name in read_array(masks[key], where).ravel()
    ]
    if unknown := [name for name in found if name not in names]:
        raise BrokenDemoError(f"{where} names {unknown[0]!r}, which the file does not have")
    return found


def demo_number(name: str) -> int:
    """Return the number of a demonstration from its name: 3 from `demo_3`."""
    return int(name.removeprefix("demo_"))


def read_pairing(handle: h5py.File, file: Path) -> Pairing:
    """Return which observation stands with an action; the original's files, which do not state it, have "libero".

    Raises:
        BrokenDemoError: The file states something else.
    """
    found = read_attribute(handle["data"], "pairing", f"{file}: data", "libero")
    if not isinstance(found, str) or found not in get_args(Pairing):
        raise BrokenDemoError(
            f"{file}: attribute pairing is {found!r}; valid: {', '.join(get_args(Pairing))}"
        )
    return "aligned" if found == "aligned" else "libero"


def check_demo(group: h5py.Group, file: Path, name: str, obs_keys: Iterable[str]) -> int:
    """Check the keys, shapes, types and sizes of one demonstration without reading it.

    Args:
        group: The demonstration.
        file: Its file, for error messages.
        name: Its name, for error messages.
        obs_keys: Observations to check.

    Returns:
        Number of bytes that it needs in memory.

    Raises:
        BrokenDemoError: The message names file, demonstration, key, and what was expected.
    """
    if not isinstance(group, h5py.Group):
        raise BrokenDemoError(f"{file}: {name} is not a group; expected actions, states, obs/ in it")
    steps, size = count_steps(group, file, name), 0
    arrays: tuple[tuple[str, tuple[int | None, ...], str], ...] = (
        ("actions", (steps, 7), "f"),
        ("states", (steps, None), "f"),
        ("robot_states", (steps, 9), "f"),
        ("expert_actions", (steps, 7), "f"),
        ("rewards", (steps,), "uif"),
        ("dones", (steps,), "uif"),
    )
    for key, shape, kind in arrays:
        if key == "actions" or key in group:
            size += _check_shape(_dataset(group, key, file, name), key, file, name, shape, kind)
    for key in obs_keys:
        dataset = _dataset(group, f"obs/{key}", file, name)
        if is_image(key):
            shape = _image_shape(key, steps, dataset.ndim)
            size += 2 * _check_shape(dataset, f"obs/{key}", file, name, shape, _image_kinds(key))  # turned
        else:
            shape = (steps, LOW_DIM_KEYS.get(key))
            size += _check_shape(dataset, f"obs/{key}", file, name, shape, "f")
    return size


def count_steps(group: h5py.Group, file: Path, name: str) -> int:
    """Return the number of steps of a demonstration; BrokenDemoError if it has none."""
    if not isinstance(group, h5py.Group):
        raise BrokenDemoError(f"{file}: {name} is not a group; expected actions, states, obs/ in it")
    actions = _dataset(group, "actions", file, name)
    if not actions.shape or actions.shape[0] == 0:
        raise BrokenDemoError(f"{file}: {name}/actions is empty; expected (T, 7) with T > 0")
    return actions.shape[0]


def is_image(key: str) -> bool:
    """Return whether an observation is an image, which is stored upside down: `agentview_rgb` is, `ee_pos` is not."""
    return key.endswith(tuple(IMAGE_KINDS))


def _image_kinds(key: str) -> str:
    return next(kinds for end, kinds in IMAGE_KINDS.items() if key.endswith(end))


def _image_shape(key: str, steps: int, ndim: int) -> tuple[int | None, ...]:
    """Return (T, H, W, 3) for colours and (T, H, W) for others, where the original has one more axis of length 1."""
    if key.endswith("_rgb"):
        return steps, None, None, 3
    return (steps, None, None, 1) if ndim == 4 else (steps, None, None)


def _dataset(group: h5py.Group, key: str, file: Path, name: str) -> h5py.Dataset:
    found = group.get(key)
    if not isinstance(found, h5py.Dataset):
        parent = group.get("obs") if key.startswith("obs/") else group
        has = ", ".join(sorted(parent)) if isinstance(parent, h5py.Group) else "nothing"
        raise BrokenDemoError(
            f"{file}: {name}/{key} is missing; expected a dataset of that name beside: {has}"
        )
    return found


def _check_shape(
    dataset: h5py.Dataset, key: str, file: Path, name: str, shape: tuple[int | None, ...], kinds: str
) -> int:
    """Check the shape and the type of a dataset; return its number of bytes in memory."""
    where = f"{file}: {name}/{key}"
    with damage_named(where):
        found, dtype = dataset.shape or (), dataset.dtype
    fits = len(found) == len(shape) and all(b in (None, a) for a, b in zip(found, shape, strict=True))
    bits = 8 if kinds == "u" else 64
    if not fits or dtype.kind not in kinds or 8 * dtype.itemsize > bits:
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        types = " or ".join({"f": "float", "u": "unsigned integer", "i": "integer"}[kind] for kind in kinds)
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


def read_values(
    group: h5py.Group, key: str, file: Path, name: str, *, check: bool = True
) -> np.ndarray | None:
    """Return an array of a demonstration whose shape has been checked; images are upright.

    Args:
        group: The demonstration.
        key: Array, such as `actions` or `obs/ee_pos`.
        file: Its file, for error messages.
        name: Its name, for error messages.
        check: Whether the values are checked, too; see `value_fault`.

    Returns:
        (T, ...); None where the demonstration does not have it.
    """
    if (dataset := group.get(key)) is None:
        return None
    where, short = f"{file}: {name}/{key}", key.removeprefix("obs/")
    values = read_array(dataset, where)
    if check and (fault := value_fault(short, values)):
        raise BrokenDemoError(f"{where} {fault}")
    if is_image(short):
        return np.ascontiguousarray(values[:, ::-1])  # the file has OpenGL rows
    return values


def reached_goal(group: h5py.Group, where: str, ends: Iterable[np.ndarray | None]) -> bool:
    """Return whether a demonstration reached its goal: what its attribute says, or that its rewards or dones end so.

    Args:
        group: The demonstration.
        where: File and name, for error messages.
        ends: Rewards and dones, where it has them.
    """
    last = [values[-1] > 0 for values in ends if values is not None]
    stated = read_attribute(group, "success", where)
    if stated is None:
        return any(last) if last else True
    if not isinstance(stated, bool | int | np.bool_ | np.integer) or int(stated) not in (0, 1):
        raise BrokenDemoError(f"{where} attribute success is {stated!r}; expected true or false")
    return bool(stated)
