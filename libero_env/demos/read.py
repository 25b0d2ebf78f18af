"""Demonstrations on disk: HDF5 in the original LIBERO's layout, read whole or not at all.

A file holds `data/demo_i` with `actions` (T, 7), `states` (T, 1 + nq + nv), `robot_states` (T, 9: fingers, gripper
position, gripper quaternion xyzw), `rewards` and `dones` (T,) uint8, and `obs/` with `agentview_rgb`,
`eye_in_hand_rgb` (T, H, W, 3) uint8 stored upside down (OpenGL rows), `gripper_states` (T, 2), `joint_states` (T, 7),
`ee_states` (T, 6), `ee_pos` (T, 3), `ee_ori` (T, 3 axis-angle, rad). States are always those before the action. Other
cameras and kinds of picture are named the same way: `<camera>_rgb`, `<camera>_depth` (T, H, W) float metres,
`<camera>_segmentation` (T, H, W) int32. The attribute `model_file` is the scene as MJCF, fixtures where they stood.

Pairing. The original stores with each action the observation *after* it. Files of this package say in the attribute
`pairing` which they hold: "aligned" (the observation the action was chosen on, the default) or "libero".

Labels. Some demonstrations are made with disturbed actions. `actions` is what was executed, so that replaying works;
`expert_actions`, where present, is what the expert wanted at that moment, which is what there is to learn.
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
PICTURES = {"_rgb": "u", "_depth": "f", "_segmentation": "iu"}  # end of a key -> kinds of number


class BrokenDemoError(DemoError):
    """What is in the file is not a demonstration, or not a whole one."""


@dataclass(frozen=True)
class Demo:
    """One demonstration. Images are upright; `states`, `rewards` and `dones` are None where the file has none."""

    name: str
    actions: np.ndarray  # (T, 7) float64 in [-1, 1]
    obs: Mapping[str, np.ndarray] = field(repr=False)  # name -> (T, ...)
    states: np.ndarray | None = field(default=None, repr=False)  # (T, 1 + nq + nv)
    rewards: np.ndarray | None = field(default=None, repr=False)  # (T,) uint8
    dones: np.ndarray | None = field(default=None, repr=False)  # (T,) uint8
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
    """Read demonstrations, after all of those wanted have been checked.

    Args:
        path: a demonstration file, ours or the original's, or the folder of parts that an interrupted recording left.
        obs_keys: observations to load; None for all known ones that the file has.
        limit: the first so many demonstrations only.
        labels: "expert" puts `expert_actions` into `Demo.actions` where the file has them, "executed" never does.
        pairing: "aligned" shifts demonstrations of "libero" pairing by one step, at the cost of their first one.

    Raises:
        DemoError: a file that is absent, truncated or empty, a key that is missing or of the wrong shape or type; the
            message names file, demonstration, key and what was expected. Nothing is returned then.
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
    """Read demonstrations one after the other, for files that do not fit in memory; see `read_demos`.

    Raises:
        DemoError: as for `read_demos`, before the first one is given; only damage that shows when an array is read
            comes later.
    """
    wanted: list[tuple[Path, list[str], list[str]]] = []
    count, shapes = 0, None
    for file in demo_files(path):
        with opened(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - count, 0)]
            keys = _wanted_keys(handle, file, names, obs_keys)
            for name in names:
                check_demo(handle["data"][name], file, name, keys)
                shapes = _same_shapes(handle["data"][name], keys, path, name, shapes)
        wanted.append((file, names, keys))
        count += len(names)
    if not count:
        raise DemoError(f"{path}: no demonstrations; expected at least data/demo_0. Record them again")
    for file, names, keys in wanted:
        with opened(file) as handle:
            for name in names:
                demo = _load(handle["data"], file, name, keys, labels)
                yield aligned(demo) if pairing == "aligned" else demo


def demo_lengths(
    path: str | Path, limit: int | None = None, *, pairing: Literal["stored", "aligned"] = "stored"
) -> list[int]:
    """Steps of each demonstration that `iter_demos` gives, without reading any.

    Raises:
        DemoError: there is no whole file, or a demonstration without actions.
    """
    lengths: list[int] = []
    for file in demo_files(path):
        with opened(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - len(lengths), 0)]
            shifted = pairing == "aligned" and _pairing(handle["data"]) == "libero"
            lengths += [
                len(_dataset(handle["data"][name], "actions", file, name)) - shifted for name in names
            ]
    return lengths


def _same_shapes(
    group: h5py.Group, keys: list[str], path: str | Path, name: str, first: tuple[str, dict] | None
) -> tuple[str, dict]:
    """The first demonstration's name and shapes of an observation; raises DemoError where this one differs."""
    found = {key: group[f"obs/{key}"].shape[1:] for key in keys}
    if first is None:
        return name, found
    for key, shape in first[1].items():
        if found.get(key) != shape:
            raise DemoError(
                f"{path}: {name}/obs/{key} holds {found.get(key, 'nothing')}; expected {shape} as in {first[0]}"
            )
    return first


def aligned(demo: Demo) -> Demo:
    """The demonstration with each action beside the observation before it; a "libero" one loses its first action."""
    if demo.pairing == "aligned":
        return demo
    states, rewards, dones = (None if x is None else x[1:] for x in (demo.states, demo.rewards, demo.dones))
    obs = {key: value[:-1] for key, value in demo.obs.items()}
    return Demo(demo.name, demo.actions[1:], obs, states, rewards, dones, demo.success, "aligned")


def demo_files(path: str | Path) -> list[Path]:
    """The file itself, or the finished parts in a folder of them.

    Raises:
        DemoError: there is nothing at the path.
    """
    path = Path(path)
    if path.is_dir():
        return sorted(path.glob("demo_*.hdf5"))
    if not path.is_file():
        raise DemoError(f"{path}: no such file; make it with `libero demos generate`")
    return [path]


def demo_names(handle: h5py.File, file: Path) -> list[str]:
    """Names of the demonstrations in numerical order.

    Raises:
        DemoError: no group `data`.
    """
    if not isinstance(handle.get("data"), h5py.Group):
        raise BrokenDemoError(
            f"{file}: key data is missing; expected a group of demonstrations demo_0, demo_1, ..."
        )
    names = [name for name in handle["data"] if name.startswith("demo_") and name[5:].isdigit()]
    return sorted(names, key=lambda name: int(name[5:]))


def check_demo(group: h5py.Group, file: Path, name: str, obs_keys: Iterable[str]) -> None:
    """Check one demonstration's keys, shapes and types without reading its images.

    Raises:
        BrokenDemoError: naming file, demonstration, key, and what was expected.
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
        if is_picture(key):
            _check_shape(
                dataset, f"obs/{key}", file, name, _picture_shape(key, steps, dataset.ndim), _kinds(key)
            )
        else:
            _check_shape(dataset, f"obs/{key}", file, name, (steps, LOW_DIM_KEYS.get(key)), "f")


def is_picture(key: str) -> bool:
    """Whether an observation is a picture, stored upside down; `obs/agentview_rgb` is, `obs/ee_pos` is not."""
    return key.endswith(tuple(PICTURES))


def _kinds(key: str) -> str:
    return next(kinds for end, kinds in PICTURES.items() if key.endswith(end))


def _picture_shape(key: str, steps: int, ndim: int) -> tuple[int | None, ...]:
    """(T, H, W, 3) of colours; (T, H, W) of others, where the original has one more axis of length 1."""
    if key.endswith("_rgb"):
        return steps, None, None, 3
    return (steps, None, None, 1) if ndim == 4 else (steps, None, None)


def opened(file: Path) -> h5py.File:
    """The file, open for reading.

    Raises:
        BrokenDemoError: it was cut short, or is no HDF5 file.
    """
    try:
        return h5py.File(file, "r")
    except OSError as error:
        raise BrokenDemoError(
            f"{file}: not a whole HDF5 file ({error}); it was cut short or is something else"
        ) from error


def _wanted_keys(
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
        known = dict.fromkeys((*IMAGE_KEYS, *filter(is_picture, sorted(obs)), *LOW_DIM_KEYS))
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
        if is_picture(key):
            obs[key] = np.ascontiguousarray(obs[key][:, ::-1])  # the file has OpenGL rows
    wanted = "expert_actions" if labels == "expert" and "expert_actions" in group else "actions"
    actions = read(wanted).astype(np.float64)
    if not np.isfinite(actions).all():
        raise BrokenDemoError(
            f"{file}: {name}/{wanted} has values that are not finite; expected numbers in [-1, 1]"
        )
    states, rewards, dones = (read(key) if key in group else None for key in ("states", "rewards", "dones"))
    ends = [x[-1] for x in (rewards, dones) if x is not None]
    success = bool(group.attrs.get("success", any(end > 0 for end in ends) if ends else True))
    return Demo(name, actions, obs, states, rewards, dones, success, _pairing(data))


def _pairing(data: h5py.Group) -> Pairing:
    """The original's files do not say it."""
    return data.attrs.get("pairing", "libero")
