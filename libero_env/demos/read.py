"""Demonstrations on disk: HDF5 in the original LIBERO's layout, read completely or not at all.

Files come from anyone: `libero_env.demos.hdf5` checks what they are made of, `libero_env.demos.contents` shapes, types
and values, before anything is learned from them.

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

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from libero_env.demos.contents import (
    IMAGE_KEYS,
    LOW_DIM_KEYS,
    Pairing,
    check_demo,
    count_steps,
    demo_names,
    is_image,
    reached_goal,
    read_pairing,
    read_values,
)
from libero_env.demos.hdf5 import BrokenDemoError, check_memory, open_demo_file, read_attribute
from libero_env.errors import DemoError


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
    plan = _plan(path, obs_keys, limit)
    check_memory(
        sum(plan.sizes), f"{path} with {len(plan.sizes)} demonstrations", "read fewer, or one at a time"
    )
    return list(_read(plan, labels, pairing))


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
    plan = _plan(path, obs_keys, limit)
    check_memory(
        max(plan.sizes), f"the longest demonstration of {path}", "record shorter ones or smaller images"
    )
    yield from _read(plan, labels, pairing)


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
            shifted = pairing == "aligned" and read_pairing(handle, file) == "libero"
            lengths += [count_steps(handle["data"][name], file, name) - shifted for name in names]
    return lengths


@dataclass(frozen=True)
class DemoOrigin:
    """What some demonstrations of a file are, and what made them.

    Attributes:
        count: Number of demonstrations.
        generator: What recorded them, such as `scripted-expert-1`; "" where the file does not say.
        digest: 16 hex digits that change with their states and actions, but not with what was drawn of them.
    """

    count: int
    generator: str
    digest: str


def demo_origin(path: str | Path, limit: int | None = None) -> DemoOrigin:
    """Return the origin of the demonstrations that `iter_demos` returns; only states and actions are read.

    Raises:
        DemoError: As for `read_demos`.
    """
    plan, digest, generators = _plan(path, (), limit), hashlib.sha256(), set()
    for file, names, _ in plan.files:
        with open_demo_file(file) as handle:
            generators.add(str(read_attribute(handle["data"], "generator", f"{file}: data", "")))
            for name in names:
                for key in ("actions", "expert_actions", "states"):
                    values = read_values(handle["data"][name], key, file, name)
                    if values is not None:
                        digest.update(f"{key} {values.shape}".encode())
                        digest.update(values.astype("<f8").tobytes())
    return DemoOrigin(len(plan.sizes), ", ".join(sorted(generators)), digest.hexdigest()[:16])


@dataclass(frozen=True)
class _Plan:
    """What is read: the names of the demonstrations of each file, their observations, and their bytes in memory."""

    files: list[tuple[Path, list[str], list[str]]]
    sizes: list[int]


def _plan(path: str | Path, obs_keys: Sequence[str] | None, limit: int | None) -> _Plan:
    """Return what is read, after everything but the values has been checked."""
    plan, shapes = _Plan([], []), None
    for file in demo_files(path):
        with open_demo_file(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - len(plan.sizes), 0)]
            keys = _requested_keys(handle, file, names, obs_keys)
            read_pairing(handle, file)
            for name in names:
                plan.sizes.append(check_demo(handle["data"][name], file, name, keys))
                shapes = _check_same_shapes(handle["data"][name], keys, path, name, shapes)
        plan.files.append((file, names, keys))
    if not plan.sizes:
        raise DemoError(f"{path}: no demonstrations; expected at least data/demo_0. Record them again")
    return plan


def _read(plan: _Plan, labels: str, pairing: str) -> Iterator[Demo]:
    for file, names, keys in plan.files:
        with open_demo_file(file) as handle:
            stored = read_pairing(handle, file)
            for name in names:
                demo = _load(handle["data"][name], file, name, keys, labels, stored)
                yield align(demo) if pairing == "aligned" else demo


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


def _load(group: h5py.Group, file: Path, name: str, keys: list[str], labels: str, pairing: Pairing) -> Demo:
    def read(key: str) -> Any:
        return read_values(group, key, file, name)

    obs = {key: read(f"obs/{key}") for key in keys}
    actions = read("expert_actions") if labels == "expert" else None
    actions = (read("actions") if actions is None else actions).astype(np.float64)
    states, rewards, dones = (read(key) for key in ("states", "rewards", "dones"))
    success = reached_goal(group, f"{file}: {name}", (rewards, dones))
    return Demo(name, actions, obs, states, rewards, dones, success, pairing)
