"""Demonstration files as a whole: which task they are of, what is in them, and files made of parts of them."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from libero_env.demos.read import (
    LOW_DIM_KEYS,
    BrokenDemoError,
    check_demo,
    demo_names,
    is_image,
    open_demo_file,
)
from libero_env.demos.write import DemoWriter, Episode
from libero_env.errors import DemoError, UnknownNameError
from libero_env.paths import demos_dir
from libero_env.storage import show_bytes
from libero_env.tasks import Task, bddl, get_suite
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.problem import same_meaning

NOOP_THRESHOLD = 1e-3  # [action units] largest motion that counts as none
_COUNTS = ("num_demos", "total", "num_failed_attempts")  # attributes that follow from the demonstrations
_DERIVED = (
    "num_samples",
    "init_state",
    "success",
    "fixtures",
)  # attributes that follow from the episode's fields


@dataclass(frozen=True)
class DemoStats:
    """Contents of a file.

    Attributes:
        lengths: Number of steps of each demonstration.
        successes: Number of demonstrations that reached the goal.
        noops: Number of no-op steps, see `noop_steps`.
        faults: What is wrong although it can be read.
    """

    lengths: tuple[int, ...]
    successes: int
    noops: int
    faults: tuple[str, ...] = ()

    def __str__(self) -> str:
        steps, n = sum(self.lengths), len(self.lengths)
        length = f"{min(self.lengths)}-{max(self.lengths)} steps (mean {steps / n:.0f})"
        return f"{length}, {self.successes} of {n} successful, {100 * self.noops / steps:.1f} % no-ops"


def read_header(file: Path) -> dict[str, Any]:
    """Return the attributes of a file's group `data`, without those that count its demonstrations.

    Raises:
        DemoError: It is not a demonstration file.
    """
    with open_demo_file(file) as handle:
        demo_names(handle, file)
        return {key: value for key, value in handle["data"].attrs.items() if key not in _COUNTS}


def recorded_robot(file: Path) -> str:
    """Return the model of the arm that was recorded, one of `libero_env.assets.robot.ROBOTS`.

    This package's files name it; those before it had a name have robosuite 1.4.1's. The original's have 1.4.0's.

    Raises:
        DemoError: It is not a demonstration file.
    """
    header = read_header(file)
    return str(header.get("robot", "robosuite-1.4.1" if "generator" in header else "libero"))


def recorded_task(file: Path) -> Task:
    """Return the task that was recorded.

    It is the benchmark's task that the file names, if the file's task text means the same, and else the task that the
    text describes.

    Raises:
        DemoError: The file names no task.
        BDDLError: Its task text cannot be read.
    """
    header = read_header(file)
    name, text = Path(str(header.get("bddl_file_name", ""))), str(header.get("bddl_file_content", ""))
    try:
        known = next((t for t in get_suite(name.parent.name).tasks if t.name == name.stem), None)
    except UnknownNameError:
        known = None
    if not text.strip():
        if known is None:
            raise DemoError(
                f"{file}: neither bddl_file_content nor bddl_file_name states which task was recorded"
            )
        return known
    problem = bddl.parse(text, f"{file} bddl_file_content")
    if known is not None and same_meaning(known.problem, problem):
        return known
    return Task("file", 0, name.stem, language_from_name(name.stem), problem.language, problem)


def read_episodes(file: Path) -> Iterator[tuple[str, Episode]]:
    """Yield the name of each demonstration with all that is recorded of it; images are upright.

    Raises:
        DemoError: A demonstration is broken, or has no states; those before it have been returned.
    """
    with open_demo_file(file) as handle:
        for name in demo_names(handle, file):
            group = handle["data"][name]
            check_demo(group, file, name, group.get("obs", ()) if isinstance(group, h5py.Group) else ())
            if "states" not in group:
                raise BrokenDemoError(f"{file}: {name}/states is missing; expected (T, 1 + nq + nv)")
            yield name, _read_episode(group, file, name)


def _read_episode(group: h5py.Group, file: Path, name: str) -> Episode:
    try:
        obs = {
            key: np.ascontiguousarray(values[()][:, ::-1]) if is_image(key) else values[()]
            for key, values in group.get("obs", {}).items()
            if is_image(key) or key in LOW_DIM_KEYS
        }
        optional = {
            key: group[key][()] if key in group else None
            for key in ("robot_states", "expert_actions", "rewards")
        }
        actions, states = group["actions"][()], group["states"][()]
    except OSError as error:
        raise BrokenDemoError(f"{file}: {name} cannot be read ({error}); the file is damaged") from error
    rewards, attrs = optional.pop("rewards"), dict(group.attrs)
    return Episode(
        actions,
        states,
        obs=obs,
        success=bool(attrs.get("success", rewards is None or rewards[-1] > 0)),
        fixtures=np.asarray(attrs["fixtures"], np.float64) if "fixtures" in attrs else None,
        attrs={key: value for key, value in attrs.items() if key not in _DERIVED},
        **optional,
    )


def noop_steps(actions: np.ndarray, threshold: float = NOOP_THRESHOLD) -> np.ndarray:
    """Return which actions do nothing: no motion, and the gripper command as before.

    Args:
        actions: (T, 7).
        threshold: Largest entry of a motion that counts as none.

    Returns:
        (T,) bool.
    """
    still = (np.abs(actions[:, :6]) <= threshold).all(axis=1)
    same_gripper = np.concatenate([[True], actions[1:, 6] == actions[:-1, 6]])
    return still & same_gripper


def examine(file: Path, *, threshold: float = NOOP_THRESHOLD) -> DemoStats:
    """Read a file completely and return what is in it.

    Args:
        file: Demonstration file.
        threshold: As for `noop_steps`.

    Raises:
        DemoError: The file is broken; the message names file, demonstration, key and what was expected.
    """
    lengths, successes, noops, faults = [], 0, 0, []
    shapes: dict[str, tuple[int, ...]] = {}
    for name, episode in read_episodes(file):
        lengths.append(len(episode))
        successes += episode.success
        noops += int(noop_steps(episode.labels, threshold).sum())
        faults += [f"{name}{fault}" for fault in _faults(episode, shapes)]
    if not lengths:
        raise DemoError(f"{file}: no demonstrations; expected at least data/demo_0. Record them again")
    with open_demo_file(file) as handle:
        counted = {key: handle["data"].attrs.get(key) for key in ("num_demos", "total")}
    for key, value in zip(counted, (len(lengths), sum(lengths)), strict=True):
        if counted[key] is not None and int(counted[key]) != value:
            faults.append(f"attribute {key} is {counted[key]}; expected {value}")
    return DemoStats(tuple(lengths), successes, noops, tuple(faults))


def _faults(episode: Episode, shapes: dict[str, tuple[int, ...]]) -> Iterator[str]:
    """Yield what is wrong with an episode; `shapes` are those of the first ones, and new keys are added to them."""
    arrays = {"actions": episode.actions, "states": episode.states}
    arrays |= {f"obs/{key}": values for key, values in episode.obs.items()}
    for key, values in arrays.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"/{key} has values that are not finite"
        if shapes.setdefault(key, values.shape[1:]) != values.shape[1:]:
            yield f"/{key} holds {values.shape[1:]}; expected {shapes[key]} as in the others"
    if missing := sorted(shapes.keys() - arrays.keys()):
        yield f" has no {', '.join(missing)}; expected them as in the others"
    if (largest := np.abs(episode.actions).max()) > 1.0 + 1e-6:
        yield f"/actions reach {largest:.2f}; expected numbers in [-1, 1]"


def filter_demos(
    file: Path,
    target: Path,
    *,
    success_only: bool = False,
    without_noops: bool = False,
    threshold: float = NOOP_THRESHOLD,
) -> DemoStats:
    """Write some of the demonstrations or steps of a file into another one; demonstrations are numbered from 0.

    Without its no-ops a demonstration can be replayed by its states, no longer by its actions. Its last step is always
    kept.

    Args:
        file: File to read.
        target: File to write; it must not exist.
        success_only: Whether to leave out demonstrations that did not reach the goal.
        without_noops: Whether to leave out the steps of `noop_steps`.
        threshold: As for `noop_steps`.

    Returns:
        Contents of the new file.

    Raises:
        DemoError: The file is broken, nothing of it is left, or the target exists.
    """
    if target.exists():
        raise DemoError(f"{target} exists; choose another name or remove it")
    dropped = [key for key, on in (("failures", success_only), ("no-ops", without_noops)) if on]
    writer = DemoWriter(
        target, {**read_header(file), "filter": f"without {' and '.join(dropped) or 'nothing'}"}
    )
    count = 0
    for name, episode in read_episodes(file):
        if success_only and not episode.success:
            continue
        keep = ~noop_steps(episode.labels, threshold) if without_noops else np.ones(len(episode), bool)
        keep[-1] = True
        kept = select_steps(episode, keep)
        writer.write(count, replace(kept, attrs={**episode.attrs, "source_demo": name}))
        count += 1
    if not count:
        raise DemoError(f"{file}: no demonstration is successful; nothing to write")
    return examine(writer.finish())


def select_steps(episode: Episode, keep: np.ndarray) -> Episode:
    """Return the episode with the steps of a mask (T,) only."""

    def select(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[keep]

    return replace(
        episode,
        actions=episode.actions[keep],
        states=episode.states[keep],
        robot_states=select(episode.robot_states),
        expert_actions=select(episode.expert_actions),
        obs={key: values[keep] for key, values in episode.obs.items()},
    )


def find_demo_files(paths: list[Path]) -> list[Path]:
    """Return the demonstration files among the given paths and in the given folders.

    Args:
        paths: Files and folders; none for the folder where demonstrations are kept.

    Raises:
        DemoError: There are none.
    """
    paths = paths or [demos_dir()]
    found = [[path] if path.suffix == ".hdf5" else sorted(path.rglob("*.hdf5")) for path in paths]
    files = [file for group in found for file in group if file in paths or _is_whole(file)]
    if not files:
        where = ", ".join(map(str, paths))
        raise DemoError(
            f"no demonstrations in {where}; record some with `libero demos generate --benchmark NAME`"
        )
    return files


def _is_whole(file: Path) -> bool:
    """Return whether a file is neither a part of an unfinished recording nor a link to another file."""
    return not file.is_symlink() and file.parent.suffix != ".parts"


def describe(file: Path) -> str:
    """Return one line about a file: demonstrations, steps, image size, failed attempts, pairing, bytes.

    Raises:
        DemoError: It is not a demonstration file.
    """
    if not file.is_file():
        raise DemoError(f"{file}: no such file")
    with open_demo_file(file) as handle:
        names = demo_names(handle, file)
        data = handle["data"]
        steps = [len(data[name]["actions"]) if "actions" in data[name] else 0 for name in names]
        obs = data[names[0]].get("obs", {}) if names else {}
        colours = [key for key in obs if key.endswith("_rgb")]
        images = "{}x{} pixels".format(*obs[colours[0]].shape[1:3]) if colours else "no images"
        failed = data.attrs.get("num_failed_attempts", "unknown")
        pairing = data.attrs.get("pairing", "libero")
        models = json.loads(data.attrs.get("models", "{}")).get("pack", "unknown")
    parts = (f"{len(names)} demonstrations", f"{sum(steps)} steps", images, f"failed attempts: {failed}")
    more = f"pairing: {pairing}, models: {models}, {show_bytes(file.stat().st_size)}"
    return f"{file}: {', '.join(parts)}, {more}"
