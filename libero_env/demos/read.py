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
from dataclasses import dataclass, field, replace
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
    demo_attributes,
    demo_names,
    is_image,
    reached_goal,
    read_pairing,
    read_values,
)
from libero_env.demos.hdf5 import BrokenDemoError, open_demo_file, read_attribute
from libero_env.errors import DemoError
from libero_env.memory import require_memory

Labels = Literal["expert", "executed"]
NOOP_THRESHOLD = 1e-3  # [action units] largest entry of a motion that counts as none
_SMALLER = "record shorter ones or smaller images"
_DERIVED = ("num_samples", "init_state", "success", "fixtures")  # attributes that follow from the fields


@dataclass(frozen=True)
class Episode:
    """One demonstration.

    Attributes:
        actions: Executed actions, (T, 7); from `read_demos` those to learn.
        states: State before each action, (T, 1 + nq + nv) time, qpos, qvel; (T, 0) where the file has none.
        robot_states: (T, 9).
        obs: Observations, name to (T, ...); images are upright. Empty until the states are rendered.
        expert_actions: Actions that the expert chose, (T, 7), where noise was added to the executed ones.
        success: Whether the goal was reached.
        fixtures: Poses of the fixtures, (nfixtures, 7) pos and quat wxyz.
        attrs: Further attributes of the demonstration.
        name: Its group in the file, such as `demo_3`.
        pairing: Which observation stands with an action.
    """

    actions: np.ndarray
    states: np.ndarray
    robot_states: np.ndarray | None = field(default=None, repr=False)
    obs: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    expert_actions: np.ndarray | None = field(default=None, repr=False)
    success: bool = True
    fixtures: np.ndarray | None = field(default=None, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict, repr=False)
    name: str = ""
    pairing: Pairing = "aligned"

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def labels(self) -> np.ndarray:
        """Actions to learn, (T, 7): those of the expert where they differ from the executed ones."""
        return self.actions if self.expert_actions is None else self.expert_actions

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays that it has beside observations, by their names in files."""
        names = ("actions", "expert_actions", "states", "robot_states")
        return {name: values for name in names if (values := getattr(self, name)) is not None}

    def aligned(self) -> "Episode":
        """Return the episode with each action paired with the observation before it.

        One of "libero" pairing loses its first action and its last observation.
        """
        if self.pairing == "aligned":
            return self
        return replace(self._selected(slice(1, None), slice(None, -1)), pairing="aligned")

    def select(self, steps: Any) -> "Episode":
        """Return the episode with some of its steps only, such as those of a mask (T,)."""
        return self._selected(steps, steps)

    def _selected(self, actions: Any, observations: Any) -> "Episode":
        def pick(values: np.ndarray | None, steps: Any) -> np.ndarray | None:
            return None if values is None else values[steps]

        return replace(
            self,
            actions=self.actions[actions],
            states=self.states[actions],
            expert_actions=pick(self.expert_actions, actions),
            robot_states=pick(self.robot_states, observations),
            obs={key: values[observations] for key, values in self.obs.items()},
        )


def noop_steps(actions: np.ndarray, threshold: float = NOOP_THRESHOLD) -> np.ndarray:
    """Return which actions (T, 7) do nothing, (T,) bool: no motion, and the gripper command as before.

    Args:
        actions: (T, 7).
        threshold: Largest entry of a motion that counts as none.
    """
    still = (np.abs(actions[:, :6]) <= threshold).all(axis=1)
    return still & keeps_gripper(actions)


def keeps_gripper(actions: np.ndarray) -> np.ndarray:
    return np.concatenate([[True], actions[1:, 6] == actions[:-1, 6]])


def read_demos(
    path: str | Path,
    obs_keys: Sequence[str] | None = None,
    limit: int | None = None,
    *,
    labels: Labels = "expert",
    pairing: Literal["stored", "aligned"] = "stored",
) -> list[Episode]:
    """Read demonstrations to learn from, after all requested ones have been checked.

    Args:
        path: A demonstration file, of this package or the original, or the folder of parts that an interrupted
            recording left.
        obs_keys: Observations to load; None for all known ones that the file has.
        limit: Largest number of demonstrations to read; None for all.
        labels: "expert" puts `expert_actions` into `actions` where the file has them, "executed" never does.
        pairing: "aligned" shifts demonstrations of "libero" pairing by one step; they lose their first action.

    Raises:
        DemoError: A file is absent, truncated or empty, or a key is missing or has the wrong shape or type. The
            message names file, demonstration, key and what was expected.
    """
    plan = _plan(path, obs_keys, limit)
    what = f"{path} with {len(plan.sizes)} demonstrations"
    require_memory(sum(plan.sizes), what, "read fewer, or one at a time", DemoError)
    return list(_read(plan, labels, pairing))


def iter_demos(
    path: str | Path,
    obs_keys: Sequence[str] | None = None,
    limit: int | None = None,
    *,
    labels: Labels = "expert",
    pairing: Literal["stored", "aligned"] = "stored",
) -> Iterator[Episode]:
    """Read demonstrations one at a time, for files that do not fit into memory; see `read_demos`.

    Raises:
        DemoError: As for `read_demos`, before the first demonstration is returned; only damage that shows when an
            array is read is found later.
    """
    plan = _plan(path, obs_keys, limit)
    what = f"the longest demonstration of {path}"
    require_memory(max(plan.sizes), what, _SMALLER, DemoError)
    yield from _read(plan, labels, pairing)


def read_episodes(file: Path, *, check_values: bool = True, observations: bool = True) -> Iterator[Episode]:
    """Read demonstrations one at a time with all that is recorded of them.

    Args:
        observations: Whether observations are read, too.
        check_values: Whether numbers that are not finite or absurd are refused.

    Raises:
        DemoError: A demonstration is broken, or has no states; those before it have been returned.
    """
    with open_demo_file(file) as handle:
        names, pairing = demo_names(handle, file), read_pairing(handle, file)
        for name in names:
            group, where = handle["data"][name], f"{file}: {name}"
            obs = group.get("obs") if isinstance(group, h5py.Group) else None
            stored = obs if observations and isinstance(obs, h5py.Group) else ()
            keys = [key for key in stored if is_image(key) or key in LOW_DIM_KEYS]
            size = check_demo(group, where, keys)
            require_memory(size, where, _SMALLER, DemoError)
            if "states" not in group:
                raise BrokenDemoError(f"{where}/states is missing; expected (T, 1 + nq + nv)")
            attrs = demo_attributes(group, where)
            yield replace(
                _load(group, where, keys, check=check_values),
                robot_states=read_values(group, "robot_states", where, check=check_values),
                fixtures=attrs.get("fixtures"),
                attrs={key: value for key, value in attrs.items() if key not in _DERIVED},
                name=name,
                pairing=pairing,
            )


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
            lengths += [count_steps(handle["data"][name], f"{file}: {name}") - shifted for name in names]
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
                    values = read_values(handle["data"][name], key, f"{file}: {name}")
                    if values is not None:
                        digest.update(f"{key} {values.shape}".encode())
                        digest.update(values.astype("<f8").tobytes())
    return DemoOrigin(len(plan.sizes), ", ".join(sorted(generators)), digest.hexdigest()[:16])


@dataclass(frozen=True)
class _Plan:
    """What is read: the names of the demonstrations of each file, their observations, and their bytes in memory."""

    files: list[tuple[Path, list[str], list[str]]] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)


def _plan(path: str | Path, obs_keys: Sequence[str] | None, limit: int | None) -> _Plan:
    """Return what is read, after everything but the values has been checked."""
    plan, first = _Plan(), None
    for file in demo_files(path):
        with open_demo_file(file) as handle:
            names = demo_names(handle, file)[: None if limit is None else max(limit - len(plan.sizes), 0)]
            keys = list(obs_keys or ())
            if obs_keys is None and names:
                keys = _stored_keys(handle["data"][names[0]], f"{file}: {names[0]}")
            read_pairing(handle, file)
            for name in names:
                group = handle["data"][name]
                plan.sizes.append(check_demo(group, f"{file}: {name}", keys))
                shapes = {key: group[f"obs/{key}"].shape[1:] for key in keys}
                first = first or (name, shapes)
                for key, shape in first[1].items():
                    if shapes.get(key) != shape:
                        raise DemoError(
                            f"{path}: {name}/obs/{key} holds {shapes.get(key, 'nothing')}; expected {shape} as in "
                            f"{first[0]}"
                        )
        plan.files.append((file, names, keys))
    if not plan.sizes:
        raise DemoError(f"{path}: no demonstrations; expected at least data/demo_0. Record them again")
    return plan


def _read(plan: _Plan, labels: Labels, pairing: str) -> Iterator[Episode]:
    for file, names, keys in plan.files:
        with open_demo_file(file) as handle:
            stored = read_pairing(handle, file)
            for name in names:
                episode = _load(handle["data"][name], f"{file}: {name}", keys, labels)
                episode = replace(episode, name=name, pairing=stored)
                yield episode.aligned() if pairing == "aligned" else episode


def _load(
    group: h5py.Group, where: str, keys: Sequence[str], labels: Labels | None = None, *, check: bool = True
) -> Episode:
    """Read the arrays of a demonstration; with `labels`, its actions are those to learn."""

    def read(key: str) -> Any:
        return read_values(group, key, where, check=check)

    expert = None if labels == "executed" else read("expert_actions")
    if labels == "expert" and expert is not None:
        actions, expert = expert, None
    else:
        actions = read("actions")
    states = read("states")
    return Episode(
        actions.astype(np.float64),
        np.zeros((len(actions), 0)) if states is None else states,
        obs={key: read(f"obs/{key}") for key in keys},
        expert_actions=expert,
        success=reached_goal(group, where, (read("rewards"), read("dones"))),
    )


def demo_files(path: str | Path) -> list[Path]:
    """Return the file itself, or the complete parts in a folder of them."""
    path = Path(path)
    return sorted(path.glob("demo_*.hdf5")) if path.is_dir() else [path]


def _stored_keys(group: h5py.Group, where: str) -> list[str]:
    """Return the known observations of a demonstration, images first."""
    obs = group.get("obs") if isinstance(group, h5py.Group) else None
    if not isinstance(obs, h5py.Group):
        raise BrokenDemoError(f"{where}/obs is missing; expected a group with {', '.join(IMAGE_KEYS)}, ...")
    ordered = dict.fromkeys((*IMAGE_KEYS, *filter(is_image, sorted(obs)), *LOW_DIM_KEYS))
    return [key for key in ordered if key in obs]
