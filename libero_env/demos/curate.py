"""Demonstration files as a whole: which task they are of, what is in them, and files made of parts of them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from libero_env.demos.contents import (
    LOW_DIM_KEYS,
    check_demo,
    count_steps,
    demo_names,
    is_image,
    reached_goal,
    read_values,
    value_fault,
)
from libero_env.demos.hdf5 import BrokenDemoError, check_memory, open_demo_file
from libero_env.demos.header import demo_attributes, file_attributes, json_attribute, read_header
from libero_env.demos.write import DemoWriter, Episode
from libero_env.errors import DemoError, UnknownNameError
from libero_env.paths import demos_dir
from libero_env.tasks import Task, bddl, get_suite
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.problem import same_meaning
from libero_env.text import show_bytes

NOOP_THRESHOLD = 1e-3  # [action units] largest motion that counts as none
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
        perturb: Perturbations under which it was rendered, as text.
    """

    lengths: tuple[int, ...]
    successes: int
    noops: int
    faults: tuple[str, ...] = ()
    perturb: str = ""

    def __str__(self) -> str:
        steps, n = sum(self.lengths), len(self.lengths)
        length = f"{min(self.lengths)}-{max(self.lengths)} steps (mean {steps / n:.0f})"
        done = f"{self.successes} of {n} successful, {100 * self.noops / steps:.1f} % no-ops"
        return f"{length}, {done}" + (f", rendered under {self.perturb}" if self.perturb else "")


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


def read_episodes(file: Path, *, check_values: bool = True) -> Iterator[tuple[str, Episode]]:
    """Yield the name of each demonstration with all that is recorded of it; images are upright.

    Args:
        file: Demonstration file.
        check_values: Whether numbers that are not finite or absurd are refused.

    Raises:
        DemoError: A demonstration is broken, or has no states; those before it have been returned.
    """
    with open_demo_file(file) as handle:
        for name in demo_names(handle, file):
            group = handle["data"][name]
            obs = group.get("obs") if isinstance(group, h5py.Group) else None
            keys = _known(obs) if isinstance(obs, h5py.Group) else []
            size = check_demo(group, file, name, keys)
            check_memory(size, f"{file}: {name}", "record shorter ones or smaller images")
            if "states" not in group:
                raise BrokenDemoError(f"{file}: {name}/states is missing; expected (T, 1 + nq + nv)")
            yield name, _read_episode(group, file, name, keys, check_values)


def _known(obs: h5py.Group) -> list[str]:
    return [key for key in obs if is_image(key) or key in LOW_DIM_KEYS]


def _read_episode(group: h5py.Group, file: Path, name: str, keys: list[str], check: bool) -> Episode:
    def read(key: str) -> Any:
        return read_values(group, key, file, name, check=check)

    attrs, rewards = demo_attributes(group, f"{file}: {name}"), read("rewards")
    return Episode(
        read("actions"),
        read("states"),
        robot_states=read("robot_states"),
        obs={key: read(f"obs/{key}") for key in keys},
        expert_actions=read("expert_actions"),
        success=reached_goal(group, f"{file}: {name}", (rewards,)),
        fixtures=attrs.get("fixtures"),
        attrs={key: value for key, value in attrs.items() if key not in _DERIVED},
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
    for name, episode in read_episodes(file, check_values=False):
        lengths.append(len(episode))
        successes += episode.success
        noops += int(noop_steps(episode.labels, threshold).sum())
        faults += [f"{name}{fault}" for fault in _faults(episode, shapes)]
    if not lengths:
        raise DemoError(f"{file}: no demonstrations; expected at least data/demo_0. Record them again")
    with open_demo_file(file) as handle:
        attributes = file_attributes(handle, file)
    for key, value in (("num_demos", len(lengths)), ("total", sum(lengths))):
        if (stated := attributes.get(key, value)) != value:
            faults.append(f"attribute {key} is {stated}; expected {value}")
    return DemoStats(tuple(lengths), successes, noops, tuple(faults), str(attributes.get("perturb", "")))


def _faults(episode: Episode, shapes: dict[str, tuple[int, ...]]) -> Iterator[str]:
    """Yield what is wrong with an episode; `shapes` are those of the first ones, and new keys are added to them."""
    arrays = {"actions": episode.actions, "states": episode.states}
    for key in ("expert_actions", "robot_states"):
        arrays |= {} if (values := getattr(episode, key)) is None else {key: values}
    arrays |= {f"obs/{key}": values for key, values in episode.obs.items()}
    for key, values in arrays.items():
        if fault := value_fault(key.removeprefix("obs/"), values):
            yield f"/{key} {fault}"
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
    writer.discard_parts()  # of an interrupted call, perhaps with another file
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
    with open_demo_file(file) as handle:
        names, header = demo_names(handle, file), file_attributes(handle, file)
        steps = sum(count_steps(handle["data"][name], file, name) for name in names)
        obs = handle["data"][names[0]].get("obs") if names else None
        colours = [key for key in obs if key.endswith("_rgb")] if isinstance(obs, h5py.Group) else []
        images = "no images"
        if colours and isinstance(obs, h5py.Group):
            check_demo(handle["data"][names[0]], file, names[0], colours)
            images = "{}x{} pixels".format(*obs[colours[0]].shape[1:3])
    models = json_attribute(header, "models", file).get("pack", "unknown")
    failed = header.get("num_failed_attempts", "unknown")
    parts = (f"{len(names)} demonstrations", f"{steps} steps", images, f"failed attempts: {failed}")
    pairing = header.get("pairing", "libero")
    more = f"pairing: {pairing}, models: {models}, {show_bytes(file.stat().st_size)}"
    more += f", rendered under {header['perturb']}" if "perturb" in header else ""
    return f"{file}: {', '.join(parts)}, {more}"
