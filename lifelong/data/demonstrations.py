"""Demonstrations of a run's tasks: recorded if there are none, read when they are needed."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from weakref import WeakValueDictionary

import torch

from libero_env.assets.pack import BUILTIN, select_pack
from libero_env.curating.rendering import RenderJob, ensure_rendered
from libero_env.demos.agreement import (
    UNSTATED,
    models_here,
    noisy_labels,
    other_control,
    recorded_frequency,
    require_alike,
    stated_facts,
)
from libero_env.demos.config import GENERATOR, DemoConfig, RenderConfig
from libero_env.demos.contents import LOW_DIM_KEYS, demo_names, json_attribute, read_header
from libero_env.demos.generate import demo_path, ensure_demos
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.observe import recorded_robot, recorded_task
from libero_env.demos.read import demo_lengths
from libero_env.doors import doors, enter
from libero_env.errors import DemoError
from libero_env.paths import demos_dir
from libero_env.perturbations import Perturbation, replace_perturbations
from libero_env.sim.scene_spec import FAST
from libero_env.storage import files_below
from libero_env.tasks import Task
from libero_env.tasks.problem import same_meaning
from libero_env.text import closest
from libero_env.timing import CONTROL_HZ
from lifelong.data import DemoSource, open_windows
from lifelong.data.settings import DataSettings
from lifelong.data.windows import StageWindows, TaskWindows
from lifelong.errors import DataError
from lifelong.types import PolicySpec

_MOST_PATHS = 100_000  # below a folder of demonstrations


def find_demos(
    tasks: Sequence[Task],
    counts: Sequence[int],
    data: DataSettings,
    progress: bool | None,
    others: Sequence[Task] = (),
    learned: Sequence[int] | None = None,
    own: bool = False,
    record: Callable[..., list[Path]] | None = None,
) -> list[Path]:
    """Return the demonstration file of each task; missing demonstrations are recorded.

    Files of `data.files` are those of the tasks that they state. Of `data.folder`, a file `<suite>/<task>_demo.hdf5`,
    the layout of the original's data sets, is used; the other tasks are recorded into it.

    Args:
        tasks: Tasks in learning order.
        counts: Number of demonstrations required of each task.
        data: Image size, robot, and the files or their folder.
        progress: Whether to show a progress bar; None shows one in a terminal, and lines otherwise.
        others: Further tasks of which `data.files` may have files, such as those of a pretraining.
        learned: Numbers of demonstrations that a saved run states, which may be somebody else's. They must be there:
            only what is required beyond them is recorded, and nothing into a folder that the run names.
        own: Whether `data.folder` is not the run's word, but the user's.
        record: Function that records missing ones, by default `ensure_demos`.

    Raises:
        DataError: A named file or folder does not exist, or demonstrations that are there cannot be used.
        DemoError: A file is broken, or demonstrations cannot be recorded.
    """
    folder, required = check_folder(data), dict[str, int]()
    for task, count in zip(tasks, counts, strict=True):  # a task may occur again, with fewer of them
        required[task.id] = max(count, required.get(task.id, 0))
    by_id = {task.id: task for task in tasks}
    files = _named_files(tasks, required, data, others)
    if folder is not None:
        left = [t for t in by_id.values() if t.id not in files]
        files = _files_in(folder, left, required, data) | files
    headers = {file: read_header(file) for file in files.values()}
    recorded = others or by_id.keys() - files.keys()
    if data.seed is not None and not recorded and not any("seed" in header for header in headers.values()):
        raise DataError(
            f"data.seed={data.seed} has no effect: no file of this run states a seed; leave it out"
        )
    unstated = [file for file, header in headers.items() if {"generator", "models"}.isdisjoint(header)]
    if unstated and (pack := select_pack().name) == BUILTIN:
        print(
            f"{unstated[0]} does not state whose models it shows; policies are evaluated on {pack} ones. For the "
            "original's demonstrations set LIBERO_ASSETS=original",
            file=sys.stderr,
        )
    if learned is not None:
        _require_recorded([t for t in tasks if t.id not in files], tasks, learned, data, own)
    _require_alike(files.values(), len(files) < len(by_id), data)
    for count in sorted(set(counts), reverse=True):
        missing = [t for t in by_id.values() if required[t.id] == count and t.id not in files]
        if not missing:
            continue
        paths = (record or ensure_demos)(
            missing,
            count,
            camera_size=(data.image_size, data.image_size),
            seed=data.seed or 0,
            drawing=data.drawing,
            root=folder,
            robot=data.robot,
            progress=progress,
        )
        files |= zip([task.id for task in missing], paths, strict=True)
    return [files[task.id] for task in tasks]


def _require_alike(files: Iterable[Path], recording: bool, data: DataSettings) -> None:
    """Check that files agree, also with what will be recorded; a DemoError names differences and `data.despite`."""
    facts = {file: stated_facts(file, data.labels) for file in files}
    if recording:
        labels = "intended" if data.labels == "expert" else "executed"
        facts[Path("what is recorded")] = {"models": models_here(), "expert": GENERATOR, "labels": labels}
    require_alike(facts, data.despite or (), "data.despite=[{1}]")


def _named_files(
    tasks: Sequence[Task], required: Mapping[str, int], data: DataSettings, others: Sequence[Task]
) -> dict[str, Path]:
    """Return the files of `data.files`, by the id of the task that each states.

    Raises:
        DataError: One is not of a task of the run or does not fit, or two are of the same task.
    """
    files: dict[str, Path] = {}
    for name, path in _each_file(tasks, required, data, others):
        stated = recorded_task(path)
        task = next((one for one in tasks if same_meaning(one.problem, stated.problem)), None)
        if task is None and any(same_meaning(one.problem, stated.problem) for one in others):
            continue
        if task is None:
            names = ", ".join(one.name for one in tasks[:5]) + (", ..." if len(tasks) > 5 else "")
            raise DataError(f"data.files: {path} is of {stated.name!r}, not of a task of this run: {names}")
        if task.id in files:
            raise DataError(f"data.files: {files[task.id]} and {path} are of the same task, {task.name!r}")
        if reason := _misfit(path, required[task.id], data):
            raise DataError(f"data.files: {name} {reason}")
        files[task.id] = path
    return files


def _each_file(
    tasks: Sequence[Task], required: Mapping[str, int], data: DataSettings, others: Sequence[Task]
) -> Iterator[tuple[str, Path]]:
    """Yield name and path of each of `data.files`; those of a data set `FORMAT:FOLDER` are made when they are there.

    Raises:
        DataError: A data set does not fit, which its first episodes show.
    """
    for name in data.files:
        form, _, folder = name.partition(":")
        if form not in doors("sets"):
            yield name, Path(name)
            continue
        read = enter("sets", form)
        for counts in (dict.fromkeys(required, 1), required):
            files = read(Path(folder).expanduser(), [*tasks, *others], counts, data.labels)
            for path in files if counts is not required else ():
                if reason := _misfit(path, 1, data):
                    raise DataError(f"data.files: {name} {reason}")
        yield from ((f"{name}, {path.stem},", path) for path in files)


def _files_in(
    folder: Path, tasks: Sequence[Task], required: Mapping[str, int], data: DataSettings
) -> dict[str, Path]:
    """Return the files of a folder that lie in the original's layout, by the id of their task.

    Raises:
        DataError: One does not fit, or the folder has files of other names, while demonstrations of a task are missing.
    """
    files: dict[str, Path] = {}
    for task in tasks:
        file = folder / task.suite / f"{task.name}_demo.hdf5"
        if file.is_file():
            if reason := _other_task(file, task) or _misfit(file, required[task.id], data):
                raise DataError(f"data.folder: {file} {reason}")
            files[task.id] = file
    if len(files) < len(tasks):  # the others are recorded
        found = islice(files_below(folder, "*"), _MOST_PATHS)
        odd = (path for path in found if path.suffix == ".hdf5" and path.parent.suffix != ".parts")
        if own := next((path for path in odd if not path.stem.endswith("_demo")), None):
            raise DataError(
                f"data.folder: {own} is not used, as it is not named SUITE/TASK_demo.hdf5: name it in data.files, "
                "which takes files by the task that they state, or have demonstrations recorded into another folder"
            )
    return files


def _recorded_path(folder: Path, task: Task, data: DataSettings) -> Path:
    """Return where the expert's demonstrations of a task are in a folder."""
    size = (data.image_size, data.image_size)
    config = DemoConfig(task, size, data.seed or 0, drawing=data.drawing, robot=data.robot)
    return demo_path(folder, config)


def _require_recorded(
    missing: Sequence[Task], tasks: Sequence[Task], learned: Sequence[int], data: DataSettings, own: bool
) -> None:
    """Check that what a saved run learned from is in a folder of the user's, so that only more of it is recorded.

    Raises:
        DataError: It is not, or the run names another folder, into which nothing is recorded; see `find_demos`.
    """
    for task in missing:
        if data.folder is not None and not own:
            raise DataError(f"data.folder: {data.folder} has no demonstrations of {task.name!r}")
        path = _recorded_path(Path(data.folder or demos_dir()), task, data)
        needed = max(n for t, n in zip(tasks, learned, strict=True) if t.id == task.id)
        there = len(demo_lengths(path, needed)) if path.is_file() else 0
        if there < needed:
            raise DataError(f"{path} has {there} of the {needed} demonstrations that the run learned from")


def _other_task(file: Path, task: Task) -> str:
    """Return that a file states another task than its name does, to follow its name; "" where it does not."""
    try:
        stated = recorded_task(file)
    except DemoError:  # it states none
        return ""
    if stated.name == task.name or same_meaning(stated.problem, task.problem):
        return ""
    return f"is of {stated.name!r}, not of {task.name!r}; data.files takes files by the task that they state"


def _misfit(file: Path, required: int, data: DataSettings) -> str:
    """Return why a file cannot be learned from with these settings, to follow its name; "" where it can."""
    header, size = read_header(file), data.image_size
    if "perturb" in header:
        return f"was rendered under {header['perturb']}; use data.perturb or stream.perturb"
    if "generator" in header and recorded_robot(file) != data.robot:
        return f"has the robot {recorded_robot(file)}; data.robot is {data.robot}"
    if (hz := recorded_frequency(file)) != CONTROL_HZ:
        return f"was recorded at {hz} Hz; runs act at {CONTROL_HZ} Hz"
    if other := other_control(file):
        return f"states {other}: runs learn relative actions of OSC_POSE"
    if data.labels == "expert" and (noisy := noisy_labels(file)):
        return f"{noisy}; data.labels=executed learns them as they are"
    if data.seed is not None and header.get("seed", data.seed) != data.seed:
        return f"was recorded with seed {header['seed']}; data.seed is {data.seed}"
    models, used = stated_facts(file, data.labels)["models"], models_here()
    if "models" not in (data.despite or ()) and models not in (UNSTATED, used):
        more = "see LIBERO_ASSETS, or use them all the same by data.despite=[models]"
        return f"shows the models {models}; those of this run are {used}: {more}"
    if json_attribute(header, "variation", file).get("reserved"):
        return "starts from the stored initial states, from which policies are evaluated"
    if data.drawing and "generator" in header and header.get("drawing", FAST) != data.drawing:
        return f"is drawn {header.get('drawing', FAST)}; data.drawing is {data.drawing}"
    available = len(demo_lengths(file, required))
    if available < required:
        return f"has {available} demonstrations and {required} are required; use data.demos={available}"
    with open_demo_file(file) as handle:
        obs = handle["data"][demo_names(handle, file)[0]].get("obs", {})
        shapes = {view: tuple(obs[view].shape[1:3]) for view in data.views if view in obs}
        readings = [name for name in LOW_DIM_KEYS if name in obs]
    if lacking := [name for name in data.proprio if name not in readings]:
        return f"has no {lacking[0]}, which data.proprio has; use of {', '.join(readings)}"
    for view in data.views:
        if view not in shapes:
            return f"has no {view}, which data.views has; `libero demos rerender` draws it"
        if shapes[view] != (size, size):
            height, width = shapes[view]
            use = f"data.image_size={height}" if height == width else "`libero demos rerender`"
            return f"has images of {height}x{width} pixels and data.image_size is {size}; use {use}"
    return ""


def check_pairing(files: Iterable[Path], data: DataSettings) -> None:
    """Check that `data.pairing=stored` pairs all actions of a run with observations in the same way.

    Args:
        files: All files that the run learns from.

    Raises:
        DataError: Some hold the observation before an action, others the one after it.
    """
    found = (
        {read_header(file).get("pairing", "libero"): file for file in files}
        if data.pairing == "stored"
        else {}
    )
    if len(found) > 1:
        raise DataError(
            f"data.pairing=stored: {found['libero']} holds the observation after an action, {found['aligned']} the one "
            "before it; use data.pairing=aligned, which pairs all with the one before"
        )


def check_folder(data: DataSettings) -> Path | None:
    """Return the folder of the demonstrations, None for the default one.

    Raises:
        DataError: It does not exist; the message names a similar folder beside it.
    """
    if data.folder is None:
        return None
    folder = Path(data.folder)
    if folder.is_dir():
        return folder
    beside = [p.name for p in folder.parent.iterdir() if p.is_dir()] if folder.parent.is_dir() else []
    near = closest(folder.name, beside)
    hint = f" Did you mean {folder.parent / near}?" if near else ""
    raise DataError(
        f"data.folder={data.folder} does not exist.{hint} To record demonstrations into a new folder, make it first"
    )


def perturb_demos(
    paths: Sequence[Path],
    tasks: Sequence[Task],
    counts: Sequence[int],
    perturb: Sequence[Sequence[Perturbation]],
    data: DataSettings,
    progress: bool | None,
    own: Sequence[Path] | None = None,
) -> list[Path]:
    """Return the files of demonstrations as they look under perturbations; what is missing is rendered beside them.

    Args:
        paths: Demonstration file of each task, from `find_demos`.
        tasks: Tasks in the same order.
        counts: Number of demonstrations required of each task.
        perturb: Perturbations of each task.
        data: Image size and drawing.
        progress: As for `find_demos`.
        own: Folders in which files may be written; None for any.

    Raises:
        DemoError: A file is broken, or cannot be written.
        DataError: One is missing beside a file that is not in these folders.
    """
    size = (data.image_size, data.image_size)
    jobs = [
        RenderJob(path, task, n, RenderConfig(size=size, drawing=data.drawing, perturb=tuple(of_task)))
        for path, task, n, of_task in zip(paths, tasks, counts, perturb, strict=True)
    ]
    places = None if own is None else [folder.resolve() for folder in own]
    for job in jobs if places is not None else ():
        is_own = any(job.path.resolve().is_relative_to(place) for place in places or ())
        if job.config.perturb and not is_own and not job.is_complete(job.n):
            raise DataError(
                f"{job.path}, {job.file} under perturbations, is missing or has too few demonstrations"
            )
    return ensure_rendered(jobs, progress=progress)


def demo_copies(
    paths: Sequence[Path],
    tasks: Sequence[Task],
    counts: Sequence[int],
    perturb: Sequence[Sequence[Perturbation]],
    data: DataSettings,
    progress: bool | None,
    own: Sequence[Path] | None = None,
) -> list[tuple[Path, ...]]:
    """Return the files of further copies of each task's demonstrations, each copy under draws of its own.

    Args:
        paths: As for `perturb_demos`.
        tasks: As for `perturb_demos`.
        counts: As for `perturb_demos`.
        perturb: Perturbations of each task; those of `data` replace those of the same kind.
        data: Perturbations and number of the copies.
        progress: As for `find_demos`.
        own: As for `perturb_demos`, with its errors.

    Raises:
        DemoError: A file is broken, or cannot be written.
    """
    of_each: list[list[Path]] = []
    for number in range(data.copies):
        draws = [replace(one, seed=one.seed + number) for one in data.perturbations()]
        of_copy = [replace_perturbations(own, draws) for own in perturb]
        of_each.append(perturb_demos(paths, tasks, counts, of_copy, data, progress, own))
    return list(zip(*of_each, strict=True)) or [()] * len(paths)


@dataclass(frozen=True)
class DemoDatasets(Mapping[int, TaskWindows]):
    """The windows of each task, by position; they are read when requested and kept while something refers to them.

    Attributes:
        paths: Demonstration file of each task.
        counts: Number of demonstrations of each task.
        spec: Views, readings and their sizes.
        languages: Embeddings of the instructions, (K, L) for K tasks.
        data: How the files are read, and where frames are held.
        copies: Files of copies of each task's demonstrations, from which its windows are, too; () for none.
        wait: Function that waits until a file is there.
    """

    paths: Sequence[Path]
    counts: Sequence[int]
    spec: PolicySpec
    languages: torch.Tensor
    data: DataSettings
    device: torch.device
    copies: Sequence[Sequence[Path]] = ()
    wait: Callable[[Path], object] = lambda path: None
    _held: WeakValueDictionary[int, TaskWindows] = field(default_factory=WeakValueDictionary)

    def __getitem__(self, task: int) -> TaskWindows:
        dataset = self._held.get(task)
        if dataset is None:
            self.wait(self.paths[task])
            copies = self.copies[task] if self.copies else ()
            parts = [self._windows(path, task) for path in (self.paths[task], *copies)]
            dataset = self._held[task] = StageWindows(parts, task) if copies else parts[0]
        return dataset

    def _windows(self, path: Path, task: int) -> TaskWindows:
        source = DemoSource(path, self.spec, self.counts[task], self.data.pairing, self.data.labels)
        return open_windows(
            source, language=self.languages[task], task_id=task, device=self.device, memory=self.data.memory
        )

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.paths)))

    def __len__(self) -> int:
        return len(self.paths)
