"""Demonstrations on disk: HDF5 in the original LIBERO's layout, read completely or not at all.

A file holds `data/demo_i` with `actions` (T, 7), `states` (T, 1 + nq + nv), `robot_states` (T, 9: fingers, gripper
position, gripper quaternion xyzw), `rewards` and `dones` (T,) uint8, and `obs/` with `agentview_rgb`,
`eye_in_hand_rgb` (T, H, W, 3) uint8 stored upside down (OpenGL rows), `gripper_states` (T, 2), `joint_states` (T, 7),
`ee_states` (T, 6), `ee_pos` (T, 3), `ee_ori` (T, 3 axis-angle, rad). States are always those before the action. Other
cameras and modalities are named the same way: `<camera>_rgb`, `<camera>_depth` (T, H, W) float metres,
`<camera>_segmentation` (T, H, W) int32. The attribute `model_file` is the scene as MJCF, with the fixtures at their
poses.

Pairing: the original stores with each action the observation *after* it. In files of this package the attribute
`pairing` states which one they hold: "aligned" (the observation on which the action was chosen, the default) or
"libero".

Labels: some demonstrations are recorded with noise on the actions. `actions` are the executed ones, so that they can be
replayed; `expert_actions`, where present, are those that the expert chose, which are the ones to learn.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from libero_env.errors import DemoError

Pairing = Literal["aligned", "libero"]

LOW_DIM_KEYS = {"gripper_states": 2, "joint_states": 7, "ee_states": 6, "ee_pos": 3, "ee_ori": 3}
IMAGE_KEYS = ("agentview_rgb", "eye_in_hand_rgb")
IMAGE_KINDS = {"_rgb": "u", "_depth": "f", "_segmentation": "iu"}  # end of a key -> kinds of NumPy dtype


class BrokenDemoError(DemoError):
    """A file or group that is not a demonstration, or not a complete one."""


@dataclass(frozen=True)
class Demo:
    """One demonstration, as it is learned from.

    Attributes:
        name: Its group in the file, such as `demo_3`.
        actions: (T, 7) float64 in [-1, 1].
        obs: Observations, name to (T, ...); images are upright.
        states: (T, 1 + nq + nv), or None where the file has none.
        rewards: (T,) uint8, or None where the file has none.
        dones: (T,) uint8, or None where the file has none.
        success: Whether the goal was reached.
        pairing: Which observation stands with an action.
    """

    name: str
    actions: np.ndarray
    obs: Mapping[str, np.ndarray] = field(repr=False)
    states: np.ndarray | None = field(default=None, repr=False)
    rewards: np.ndarray | None = field(default=None, repr=False)
    dones: np.ndarray | None = field(default=None, repr=False)
    success: bool = True
    pairing: Pairing = "aligned"

    def __len__(self) -> int:
        return len(self.actions)


def read_demos(
    path: str | Path,
    obs_keys: Sequence[str] | None = None,
    limit: int | None = None,
    *,
    labels: Literal["expert", "executed"] = "expert",
    pairing: Literal["stored", "aligned"] = "stored",
) -> list[Demo]:
    """Read demonstrations, after all requested ones have been checked.

    Args:
        path: A demonstration file, of this package or the original, or the folder of parts that an interrupted
            recording left.
        obs_keys: Observations to load; None for all known ones that the file has.
        limit: Largest number of demonstrations to read; None for all.
        labels: "expert" puts `expert_actions` into `Demo.actions` where the file has them, "executed" never does.
        pairing: "aligned" shifts demonstrations of "libero" pairing by one step; they lose their first action.

    Raises:
        DemoError: A file is absent, truncated or empty, or a key is missing or has the wrong shape or type. The
            message names file, demonstration, key and what was expected.
    """
    return list(iter_demos(path, obs_keys, limit, labels=labels, pairing=pairing))


def iter_demos(
    path: str | Path,
    obs_keys: Sequence[str] | None = None,
    limit: int | None = None,
    *,
    labels: Literal["expert", "executed"] = "expert",
    pairing: Literal["stored", "aligned"] = "stored",
) -> Iterator[Demo]:
    """Read demonstrations one at a time, for files that do not fit into memory; see `read_demos`.

    Raises:
        DemoError: As for `read_demos`, before the first demonstration is returned; only damage that shows when an
            array is read is found later.
    """
    requested: list[tuple[Path, list[str], list[str]]] = []
    count, shapes = 0, None
    for file in demo_files(path):
        with open_demo_file(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - count, 0)]
            keys = _requested_keys(handle, file, names, obs_keys)
            for name in names:
                check_demo(handle["data"][name], file, name, keys)
                shapes = _check_same_shapes(handle["data"][name], keys, path, name, shapes)
        requested.append((file, names, keys))
        count += len(names)
    if not count:
        raise DemoError(f"{path}: no demonstrations; expected at least data/demo_0. Record them again")
    for file, names, keys in requested:
        with open_demo_file(file) as handle:
            for name in names:
                demo = _load(handle["data"], file, name, keys, labels)
                yield align(demo) if pairing == "aligned" else demo


def demo_lengths(
    path: str | Path, limit: int | None = None, *, pairing: Literal["stored", "aligned"] = "stored"
) -> list[int]:
    """Return the number of steps of each demonstration that `iter_demos` returns, without reading any.

    Raises:
        DemoError: A file is absent or truncated, or a demonstration has no actions.
    """
    lengths: list[int] = []
    for file in demo_files(path):
        with open_demo_file(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - len(lengths), 0)]
            shifted = pairing == "aligned" and _pairing(handle["data"]) == "libero"
            lengths += [
                len(_dataset(handle["data"][name], "actions", file, name)) - shifted for name in names
            ]
    return lengths


def _check_same_shapes(
    group: h5py.Group, keys: list[str], path: str | Path, name: str, first: tuple[str, dict] | None
) -> tuple[str, dict]:
    """Return the name and the observations' shapes of the first demonstration; raise DemoError if this one differs."""
    found = {key: group[f"obs/{key}"].shape[1:] for key in keys}
    if first is None:
        return name, found
    for key, shape in first[1].items():
        if found.get(key) != shape:
            raise DemoError(
                f"{path}: {name}/obs/{key} holds {found.get(key, 'nothing')}; expected {shape} as in {first[0]}"
            )
    return first


def align(demo: Demo) -> Demo:
    """Return the demonstration with each action paired with the observation before it.

    A demonstration of "libero" pairing loses its first action and its last observation.
    """
    if demo.pairing == "aligned":
        return demo
    states, rewards, dones = (None if x is None else x[1:] for x in (demo.states, demo.rewards, demo.dones))
    obs = {key: value[:-1] for key, value in demo.obs.items()}
    return Demo(demo.name, demo.actions[1:], obs, states, rewards, dones, demo.success, "aligned")


def demo_files(path: str | Path) -> list[Path]:
    """Return the file itself, or the complete parts in a folder of them.

    Raises:
        DemoError: There is nothing at the path.
    """
    path = Path(path)
    if path.is_dir():
        return sorted(path.glob("demo_*.hdf5"))
    if not path.is_file():
        raise DemoError(f"{path}: no such file; record it with `libero demos generate`")
    return [path]


def demo_names(handle: h5py.File, file: Path) -> list[str]:
    """Return the names of the demonstrations in numerical order.

    Raises:
        BrokenDemoError: The file has no group `data`.
    """
    if not isinstance(handle.get("data"), h5py.Group):
        raise BrokenDemoError(
            f"{file}: key data is missing; expected a group of demonstrations demo_0, demo_1, ..."
        )
    names = [name for name in handle["data"] if name.startswith("demo_") and name[5:].isdigit()]
    return sorted(names, key=demo_number)


def demo_number(name: str) -> int:
    """Return the number of a demonstration from its name: 3 from `demo_3`."""
    return int(name.removeprefix("demo_"))


def check_demo(group: h5py.Group, file: Path, name: str, obs_keys: Iterable[str]) -> None:
    """Check the keys, shapes and types of one demonstration without reading its images.

    Args:
        group: The demonstration.
        file: Its file, for error messages.
        name: Its name, for error messages.
        obs_keys: Observations to check.

    Raises:
        BrokenDemoError: The message names file, demonstration, key, and what was expected.
    """
    if not isinstance(group, h5py.Group):
        raise BrokenDemoError(f"{file}: {name} is not a group; expected actions, states, obs/ in it")
    actions = _dataset(group, "actions", file, name)
    steps = actions.shape[0] if actions.ndim else 0
    if steps == 0:
        raise BrokenDemoError(f"{file}: {name}/actions is empty; expected (T, 7) with T > 0")
    _check_shape(actions, "actions", file, name, (steps, 7), "f")
    for key, shape, kind in (
        ("states", (steps, None), "f"),
        ("robot_states", (steps, 9), "f"),
        ("expert_actions", (steps, 7), "f"),
        ("rewards", (steps,), "uif"),
        ("dones", (steps,), "uif"),
    ):
        if key in group:
            _check_shape(_dataset(group, key, file, name), key, file, name, shape, kind)
    for key in obs_keys:
        dataset = _dataset(group, f"obs/{key}", file, name)
        if is_image(key):
            image_shape = _image_shape(key, steps, dataset.ndim)
            _check_shape(dataset, f"obs/{key}", file, name, image_shape, _image_kinds(key))
        else:
            _check_shape(dataset, f"obs/{key}", file, name, (steps, LOW_DIM_KEYS.get(key)), "f")


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


def open_demo_file(file: Path) -> h5py.File:
    """Open a demonstration file for reading.

    Raises:
        BrokenDemoError: The file is truncated, or is no HDF5 file.
    """
    try:
        return h5py.File(file, "r")
    except OSError as error:
        raise BrokenDemoError(
            f"{file}: not a complete HDF5 file ({error}); it is truncated, or of another format"
        ) from error


def _requested_keys(
    handle: h5py.File, file: Path, names: list[str], obs_keys: Sequence[str] | None
) -> list[str]:
    if obs_keys is not None:
        return list(obs_keys)
    for name in names:
        obs = handle["data"][name].get("obs") if isinstance(handle["data"][name], h5py.Group) else None
        if not isinstance(obs, h5py.Group):
            raise BrokenDemoError(
                f"{file}: {name}/obs is missing; expected a group with {', '.join(IMAGE_KEYS)}, ..."
            )
        known = dict.fromkeys((*IMAGE_KEYS, *filter(is_image, sorted(obs)), *LOW_DIM_KEYS))
        return [key for key in known if key in obs]
    return []


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
) -> None:
    fits = dataset.ndim == len(shape) and all(
        b in (None, a) for a, b in zip(dataset.shape, shape, strict=True)
    )
    if not fits or dataset.dtype.kind not in kinds:
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        types = " or ".join({"f": "float", "u": "unsigned integer", "i": "integer"}[kind] for kind in kinds)
        raise BrokenDemoError(
            f"{file}: {name}/{key} is {dataset.shape} {dataset.dtype}; expected ({expected}) {types}"
        )


def _load(data: h5py.Group, file: Path, name: str, keys: list[str], labels: str) -> Demo:
    group = data[name]

    def read(key: str) -> np.ndarray:
        try:
            return group[key][()]
        except OSError as error:
            raise BrokenDemoError(
                f"{file}: {name}/{key} cannot be read ({error}); the file is damaged"
            ) from error

    obs = {key: read(f"obs/{key}") for key in keys}
    for key in obs:
        if is_image(key):
            obs[key] = np.ascontiguousarray(obs[key][:, ::-1])  # the file has OpenGL rows
    label_key = "expert_actions" if labels == "expert" and "expert_actions" in group else "actions"
    actions = read(label_key).astype(np.float64)
    if not np.isfinite(actions).all():
        raise BrokenDemoError(
            f"{file}: {name}/{label_key} has values that are not finite; expected numbers in [-1, 1]"
        )
    states, rewards, dones = (read(key) if key in group else None for key in ("states", "rewards", "dones"))
    ends = [x[-1] for x in (rewards, dones) if x is not None]
    success = bool(group.attrs.get("success", any(end > 0 for end in ends) if ends else True))
    return Demo(name, actions, obs, states, rewards, dones, success, _pairing(data))


def _pairing(data: h5py.Group) -> Pairing:
    return data.attrs.get("pairing", "libero")  # the original's files do not state it
