"""Demonstration files as a whole: whose they are, what is in them, and parts of them in a file of their own."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from libero_env.demos.read import LOW_DIM_KEYS, BrokenDemoError, check_demo, demo_names, is_picture, opened
from libero_env.demos.write import DemoWriter, Episode
from libero_env.errors import DemoError, UnknownNameError
from libero_env.paths import demos_dir
from libero_env.storage import show_bytes
from libero_env.tasks import Task, bddl, get_suite
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.problem import same_meaning

NOOP = 1e-3  # largest entry of an action's motion that counts as none
_COUNTED = ("num_demos", "total", "num_failed_attempts")  # attributes that follow from the demonstrations
_OWN = ("num_samples", "init_state", "success")  # likewise, of one demonstration


@dataclass(frozen=True)
class DemoStats:
    """What is in a file.

    Attributes:
        lengths: steps of each demonstration.
        successes: how many reached the goal.
        noops: steps in which nothing was wanted of the arm.
        faults: what is wrong although it can be read.
    """

    lengths: tuple[int, ...]
    successes: int
    noops: int
    faults: tuple[str, ...] = ()

    def __str__(self) -> str:
        steps, n = sum(self.lengths), len(self.lengths)
        length = f"{min(self.lengths)}-{max(self.lengths)} steps (mean {steps / n:.0f})"
        return f"{length}, {self.successes} of {n} successful, {100 * self.noops / steps:.1f} % no-ops"


def header_of(file: Path) -> dict[str, Any]:
    """Attributes of a file's group `data`, those aside that count its demonstrations.

    Raises:
        DemoError: it is not a demonstration file.
    """
    with opened(file) as handle:
        demo_names(handle, file)
        return {key: value for key, value in handle["data"].attrs.items() if key not in _COUNTED}


def task_of(file: Path) -> Task:
    """The task that was recorded: one of ours where the file names it and means the same, else what its text says.

    Raises:
        DemoError: the file names no task.
        BDDLError: its task text cannot be read.
    """
    header = header_of(file)
    name, text = Path(str(header.get("bddl_file_name", ""))), str(header.get("bddl_file_content", ""))
    try:
        known = next((t for t in get_suite(name.parent.name).tasks if t.name == name.stem), None)
    except UnknownNameError:
        known = None
    if not text.strip():
        if known is None:
            raise DemoError(
                f"{file}: neither bddl_file_content nor bddl_file_name says which task was recorded"
            )
        return known
    problem = bddl.parse(text, f"{file} bddl_file_content")
    if known is not None and same_meaning(known.problem, problem):
        return known
    return Task("file", 0, name.stem, language_from_name(name.stem), problem.language, problem)


def read_episodes(file: Path) -> Iterator[tuple[str, Episode]]:
    """(name, all that is recorded) of each demonstration in turn; pictures are upright.

    Raises:
        DemoError: at the first demonstration that is broken, or has no states.
    """
    with opened(file) as handle:
        for name in demo_names(handle, file):
            group = handle["data"][name]
            check_demo(group, file, name, group.get("obs", ()) if isinstance(group, h5py.Group) else ())
            if "states" not in group:
                raise BrokenDemoError(f"{file}: {name}/states is missing; expected (T, 1 + nq + nv)")
            yield name, _read_episode(group, file, name)


def _read_episode(group: h5py.Group, file: Path, name: str) -> Episode:
    try:
        obs = {
            key: np.ascontiguousarray(values[()][:, ::-1]) if is_picture(key) else values[()]
            for key, values in group.get("obs", {}).items()
            if is_picture(key) or key in LOW_DIM_KEYS
        }
        arrays = {
            k: group[k][()] if k in group else None for k in ("robot_states", "expert_actions", "rewards")
        }
        actions, states = group["actions"][()], group["states"][()]
    except OSError as error:
        raise BrokenDemoError(f"{file}: {name} cannot be read ({error}); the file is damaged") from error
    rewards, attrs = arrays.pop("rewards"), dict(group.attrs)
    success = bool(attrs.get("success", rewards is None or rewards[-1] > 0))
    own = {key: value for key, value in attrs.items() if key not in _OWN}
    return Episode(actions, states, obs=obs, success=success, attrs=own, **arrays)


def noops(actions: np.ndarray, threshold: float = NOOP) -> np.ndarray:
    """Which of the actions (T, 7) want nothing: no motion, and the gripper as before; (T,) bool."""
    still = (np.abs(actions[:, :6]) <= threshold).all(axis=1)
    same = np.concatenate([[True], actions[1:, 6] == actions[:-1, 6]])
    return still & same


def examine(file: Path, *, threshold: float = NOOP) -> DemoStats:
    """Read a file whole and say what is in it.

    Raises:
        DemoError: it is broken; the message names file, demonstration, key and what was expected.
    """
    lengths, successes, still, faults = [], 0, 0, []
    shapes: dict[str, tuple[int, ...]] = {}
    for name, episode in read_episodes(file):
        lengths.append(len(episode.actions))
        successes += episode.success
        still += int(noops(_labels(episode), threshold).sum())
        arrays = {"actions": episode.actions, "states": episode.states}
        arrays |= {f"obs/{key}": values for key, values in episode.obs.items()}
        for key, values in arrays.items():
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                faults.append(f"{name}/{key} has values that are not finite")
            if shapes.setdefault(key, values.shape[1:]) != values.shape[1:]:
                faults.append(
                    f"{name}/{key} holds {values.shape[1:]}; expected {shapes[key]} as in the others"
                )
        if missing := sorted(shapes.keys() - arrays.keys()):
            faults.append(f"{name} has no {', '.join(missing)}; expected them as in the others")
        if np.abs(episode.actions).max() > 1.0 + 1e-6:
            faults.append(
                f"{name}/actions reach {np.abs(episode.actions).max():.2f}; expected numbers in [-1, 1]"
            )
    if not lengths:
        raise DemoError(f"{file}: no demonstrations; expected at least data/demo_0. Record them again")
    with opened(file) as handle:
        counted = {key: handle["data"].attrs.get(key) for key in ("num_demos", "total")}
    for key, value in zip(counted, (len(lengths), sum(lengths)), strict=True):
        if counted[key] is not None and int(counted[key]) != value:
            faults.append(f"attribute {key} is {counted[key]}; expected {value}")
    return DemoStats(tuple(lengths), successes, still, tuple(faults))


def filter_demos(
    file: Path,
    target: Path,
    *,
    success_only: bool = False,
    without_noops: bool = False,
    threshold: float = NOOP,
) -> DemoStats:
    """Write what is wanted of a file into another one, demonstrations numbered anew; says what is there then.

    Without its no-ops a demonstration no longer replays by its actions; by its states it does. The last step stays.

    Args:
        file: to read.
        target: to write; must not be there.
        success_only: leave out demonstrations that did not reach the goal.
        without_noops: leave out steps of `noops`.
        threshold: of `noops`.

    Raises:
        DemoError: the file is broken, nothing of it is wanted, or the target exists.
    """
    if target.exists():
        raise DemoError(f"{target} exists; choose another name or remove it")
    dropped = [key for key, on in (("failures", success_only), ("no-ops", without_noops)) if on]
    writer = DemoWriter(
        target, {**header_of(file), "filter": f"without {' and '.join(dropped) or 'nothing'}"}
    )
    count = 0
    for name, episode in read_episodes(file):
        if success_only and not episode.success:
            continue
        keep = ~noops(_labels(episode), threshold) if without_noops else np.ones(len(episode.actions), bool)
        keep[-1] = True
        writer.write(count, replace(select(episode, keep), attrs={**episode.attrs, "source_demo": name}))
        count += 1
    if not count:
        raise DemoError(f"{file}: no demonstration is successful; nothing to write")
    return examine(writer.finish())


def select(episode: Episode, keep: np.ndarray) -> Episode:
    """Some of the steps of a demonstration, by a mask (T,)."""

    def cut(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[keep]

    return replace(
        episode,
        actions=episode.actions[keep],
        states=episode.states[keep],
        robot_states=cut(episode.robot_states),
        expert_actions=cut(episode.expert_actions),
        obs={key: values[keep] for key, values in episode.obs.items()},
    )


def _labels(episode: Episode) -> np.ndarray:
    """What the expert wanted, which is what there is to learn."""
    return episode.actions if episode.expert_actions is None else episode.expert_actions


def find_files(paths: list[Path]) -> list[Path]:
    """The demonstration files that the paths name or hold.

    Raises:
        DemoError: there is none.
    """
    from libero_env.errors import DemoError

    paths = paths or [demos_dir()]
    found = [[path] if path.suffix == ".hdf5" else sorted(path.rglob("*.hdf5")) for path in paths]
    files = [file for group in found for file in group]
    if not files:
        where = ", ".join(map(str, paths))
        raise DemoError(
            f"no demonstrations in {where}; record some with `libero demos generate --benchmark NAME`"
        )
    return files


def describe(path: Path) -> str:
    """How many demonstrations a file holds, their steps and pictures, and how many attempts failed.

    Raises:
        DemoError: it is not a demonstration file.
    """
    from libero_env.demos.read import demo_names, opened
    from libero_env.errors import DemoError

    if not path.is_file():
        raise DemoError(f"{path}: no such file")
    with opened(path) as handle:
        names = demo_names(handle, path)
        data = handle["data"]
        steps = [len(data[name]["actions"]) if "actions" in data[name] else 0 for name in names]
        obs = data[names[0]].get("obs", {}) if names else {}
        colours = [key for key in obs if key.endswith("_rgb")]
        seen = "{}x{} pixels".format(*obs[colours[0]].shape[1:3]) if colours else "no pictures"
        failed = data.attrs.get("num_failed_attempts", "unknown")
        pairing = data.attrs.get("pairing", "libero")
    parts = (f"{len(names)} demonstrations", f"{sum(steps)} steps", seen, f"failed attempts: {failed}")
    return f"{path}: {', '.join(parts)}, pairing: {pairing}, {show_bytes(path.stat().st_size)}"
