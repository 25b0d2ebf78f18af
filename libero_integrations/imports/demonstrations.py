"""Data sets of other tools as demonstration files: `data.files=lerobot:FOLDER` and `data.files=rlds:FOLDER`.

Episodes are sorted by their instructions and kept in the cache as HDF5, a file for each task, which are checked as any
others. How a data set was made is in its `meta/libero.json`, as exports write it; one without that file is read as the
published set whose features it has, and a line says so.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from typing_extensions import TypedDict

from libero_env.demos.config import task_home
from libero_env.demos.generate import DemoJob, claim_incomplete
from libero_env.demos.hdf5 import damage_named
from libero_env.demos.read import Episode, Labels
from libero_env.demos.write import DemoWriter, make_header
from libero_env.errors import DemoError, UnknownNameError
from libero_env.images import flip_rows, rotate_180
from libero_env.paths import cache_dir
from libero_env.progress import tell_progress
from libero_env.storage import files_below, read_json
from libero_env.tasks import Task, get_suite
from libero_env.text import counted, shown
from libero_env.timing import CONTROL_HZ
from libero_env.validation import validate
from libero_integrations.exports.layouts import GRIPPER, ORIGIN, PUBLISHED, RECORDED, Layout
from libero_integrations.imports.lerobot import LeRobotSet
from libero_integrations.imports.rlds import RldsSet

_LAYOUTS = (*PUBLISHED.values(), *RECORDED.values())
_CAMERAS = {feature: camera for layout in _LAYOUTS for camera, feature in layout.cameras.items()}


class _Images(TypedDict):
    first_row: Literal["top", "bottom"]
    mirrored: bool


class _Stated(TypedDict):
    """What `meta/libero.json` has to say; the file's other attributes are checked where they are used."""

    images: _Images
    gripper: Literal["-1 opens, +1 closes", "1 opens, 0 closes"]
    control_hz: int


def _files(
    kind: str,
    reader: type[LeRobotSet] | type[RldsSet],
    folder: Path,
    tasks: Sequence[Task],
    counts: Mapping[str, int],
    labels: Labels,
) -> list[Path]:
    """Return the demonstration file of each task of which a data set has episodes; what is missing is converted.

    Args:
        kind: Name of the format.
        reader: Class that reads it.
        folder: The data set.
        tasks: Tasks of which it may have episodes.
        counts: Id of a task -> number of demonstrations; tasks that are not among them are not converted.
        labels: Which actions are to be learned.

    Raises:
        DemoError: It is broken, does not say how it was made, or has no episode of any of the tasks.
    """
    where = f"{kind}:{folder}"
    if not folder.is_dir():
        raise DemoError(f"{where}: there is no such folder")
    data_set = reader(folder)
    origin = _read_origin(folder, data_set.layout, where)
    if origin.get("actions_are") == "intended" and labels == "executed":
        raise DemoError(f"{where} has the intended actions only, and data.labels=executed")
    place, jobs = cache_dir() / "sets" / _digest(where, folder, origin), dict[str, SetJob]()
    for task in tasks:
        if task.id in counts:
            path = place / task_home(task) / f"{task.name}_demo.hdf5"
            jobs[_words(task)] = SetJob(task, path, origin, where)
    with claim_incomplete((job, counts[job.task.id]) for job in jobs.values()) as incomplete:
        missing = {_words(job.task): job.missing(counts[job.task.id]) for job in incomplete}
        if missing:
            tell_progress(f"converting {where}, up to {counted(sum(map(len, missing.values())), 'episode')}")
            _convert(data_set, tasks, jobs, missing)
    return [job.path for job in jobs.values() if job.path.is_file()]


lerobot_files, rlds_files = partial(_files, "lerobot", LeRobotSet), partial(_files, "rlds", RldsSet)


def _convert(
    data_set: LeRobotSet | RldsSet,
    tasks: Sequence[Task],
    jobs: "Mapping[str, SetJob]",
    missing: Mapping[str, set[int]],
) -> None:
    """Write episodes into the files of jobs, by the words of their instructions; `missing` are their numbers."""
    seen, where = dict[str, int](), next(iter(jobs.values())).where
    for instruction, read in data_set.episodes():
        words = _words(instruction)
        number = seen[words] = seen.get(words, -1) + 1
        if number in missing.get(words, ()):
            _require_one(jobs[words].task, tasks, where)
            jobs[words].write(number, read())
            missing[words].remove(number)
            if not any(missing.values()):
                break
    if seen.keys().isdisjoint(map(_words, tasks)):
        names = ", ".join(map(repr, list(seen)[:3]))
        raise DemoError(f"{where} has no episode of a task of this run; its instructions are {names}, ...")
    for words in missing.keys() & seen.keys():
        jobs[words].writer.finish()


def _require_one(task: Task, tasks: Sequence[Task], where: str) -> None:
    """Raise a DemoError where several tasks have the instruction of a task, in the run or in its suite."""
    try:
        suite = get_suite(task.suite).tasks
    except UnknownNameError:  # of the user
        suite = ()
    same = {one.id for one in (*suite, *tasks) if _words(one) == _words(task)}
    if len(same) > 1:
        raise DemoError(
            f"{where}: {task.language!r} is the instruction of {', '.join(sorted(same))}, and episodes do not say of "
            "which they are: leave these tasks out"
        )


@dataclass(frozen=True)
class SetJob(DemoJob):
    """The demonstration file of a task of a data set.

    Attributes:
        origin: How the data set was made, as in `meta/libero.json`.
        where: Its name, for error messages.
    """

    task: Task
    path: Path
    origin: Mapping[str, Any]
    where: str

    @cached_property
    def writer(self) -> DemoWriter:
        return DemoWriter(self.path, _header(self.task, self.origin))

    def missing(self, n: int) -> set[int]:
        """Return which of the first `n` episodes are not converted; see `DemoJob`."""
        return set(range(n)) - self.writer.recorded()

    def write(self, number: int, episode: Episode) -> None:
        """Write an episode as demonstration `number`.

        Raises:
            DemoError: Its actions are not relative ones of `osc_pose`, with the gripper's signs that are stated.
        """
        where, actions, stated = (
            f"{self.where}: {episode.name}",
            episode.actions.astype(float),
            self.origin["gripper"],
        )
        if actions.shape[1:] != (7,):
            raise DemoError(
                f"{where} has actions {actions.shape}; expected (T, 7), relative ones of OSC_POSE"
            )
        if (largest := np.abs(actions[:, :6]).max()) > 1.0:
            raise DemoError(
                f"{where} has a motion of {largest:g}; expected relative ones of OSC_POSE, in [-1, 1]"
            )
        gripper, opens = actions[:, 6], stated == GRIPPER[True]
        if gripper.min() < 0.0 if opens else set(gripper) <= {0.0, 1.0} and 0.0 in gripper:
            values = shown(sorted(set(gripper.tolist())), 30)
            raise DemoError(f"{where} has {values} for the gripper, and {stated}")
        if opens:
            actions[:, 6] = 1.0 - 2.0 * gripper
        obs = {key: values for key, values in episode.obs.items() if values.ndim == 2}
        for feature, frames in episode.obs.items():
            if frames.ndim == 4:  # names of no known layout are those of cameras
                camera = _CAMERAS.get(feature, feature.rpartition(".")[2])
                obs[f"{camera}_rgb"] = self._upright(frames)
        intended = actions if self.origin.get("actions_are") == "intended" else None
        self.writer.write(number, replace(episode, actions=actions, expert_actions=intended, obs=obs))

    def _upright(self, frames: np.ndarray) -> np.ndarray:
        """Return images with the first row on top, as the camera sees the scene."""
        images = self.origin["images"]
        frames = flip_rows(frames, 1) if images["first_row"] == "bottom" else frames
        return rotate_180(flip_rows(frames, 1), 1) if images["mirrored"] else frames


def _header(task: Task, origin: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a demonstration file, which say what the data set says of itself."""
    control = {"type": origin.get("controller"), "control_delta": origin.get("control_delta")}
    control = {key: value for key, value in control.items() if value is not None}
    models = origin.get("models")
    if isinstance(models, list):
        models = models[0] if len(models) == 1 else models and {"pack": shown(models)}
    extra = {key: origin.get(key) for key in ("robot", "drawing", "perturb")}
    extra |= {"generator": origin.get("expert"), "models": json.dumps(models) if models else None}
    return make_header(
        problem_name=task.problem.name,
        language=task.language,
        bddl_name=f"{task_home(task)}/{task.name}.bddl",
        bddl_text=task.bddl_text,
        env_kwargs={"control_freq": origin["control_hz"], "controller_configs": control},
        pairing="aligned",
        **{key: value for key, value in extra.items() if value not in (None, "none", "not stated")},
    )


def _read_origin(folder: Path, layout: Layout | None, where: str) -> Mapping[str, Any]:
    """Return how a data set was made: what its file says, or what is known of the published one it looks like."""
    file = next((f for f in (folder / ORIGIN, folder.parent / ORIGIN) if f.is_file()), None)
    if file is not None:
        stated = read_json(file, DemoError)
        with damage_named(str(file)):
            known = {key: stated[key] for key in _Stated.__annotations__ if key in stated}
            known["images"] = {key: known.get("images", {})[key] for key in _Images.__annotations__}
            return {**stated, **validate(_Stated, known, source=str(file), error=DemoError)}
    if layout is None:
        raise DemoError(
            f"{where} does not say how it was made, and has not the features of a published set: write {ORIGIN} with "
            "images.first_row, images.mirrored, gripper and control_hz, as libero demos export does"
        )
    name, gripper = (
        next(name for name, one in PUBLISHED.items() if one is layout),
        GRIPPER[layout.open_gripper],
    )
    tell_progress(
        f"{where} has no {ORIGIN}: read as {name}, with mirrored images, at {CONTROL_HZ} Hz, {gripper}"
    )
    images = {"first_row": "top", "mirrored": layout.mirrored}
    return {"images": images, "gripper": gripper, "control_hz": CONTROL_HZ}


def _words(instruction: str | Task) -> str:
    text = instruction if isinstance(instruction, str) else instruction.language
    return " ".join(text.split()).casefold()


def _digest(where: str, folder: Path, origin: Mapping[str, Any]) -> str:
    """Return 16 hex digits that change with the files of a folder, by names, sizes and times, and with its origin."""
    stats = ((path, path.stat()) for path in sorted(files_below(folder.resolve(), "*")) if path.is_file())
    lines = "".join(f"{path}\0{stat.st_size}\0{stat.st_mtime_ns}\n" for path, stat in stats)
    made = json.dumps(origin, sort_keys=True, default=str)
    return hashlib.sha256(f"{where}\n{lines}{made}".encode()).hexdigest()[:16]
