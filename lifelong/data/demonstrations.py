"""Demonstrations of a run's tasks: recorded if there are none, read when they are needed."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from weakref import WeakValueDictionary

import torch

from libero_env.assets.pack import BUILTIN, select_pack
from libero_env.demos.config import DemoConfig, RenderConfig
from libero_env.demos.contents import demo_names, json_attribute, read_header
from libero_env.demos.generate import demo_path, ensure_demos
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.observe import recorded_frequency, recorded_robot, recorded_task
from libero_env.demos.read import demo_lengths
from libero_env.demos.rendering import RenderJob, ensure_rendered
from libero_env.errors import DemoError
from libero_env.perturbations import Perturbation, replace_perturbations
from libero_env.sim.scene import FAST
from libero_env.tasks import Task
from libero_env.tasks.problem import same_meaning
from libero_env.text import closest
from libero_env.timing import CONTROL_HZ
from lifelong.data import DemoSource, open_windows
from lifelong.data.settings import DataSettings
from lifelong.data.windows import StageWindows, TaskWindows
from lifelong.errors import DataError
from lifelong.types import PolicySpec


def find_demos(
    tasks: Sequence[Task],
    counts: Sequence[int],
    data: DataSettings,
    progress: bool | None,
    others: Sequence[Task] = (),
) -> list[Path]:
    """Return the demonstration file of each task; missing demonstrations are recorded.

    Files of `data.files` are those of the tasks that they state. Of `data.folder`, a file `<suite>/<task>_demo.hdf5`,
    the layout of the original's data sets, is used, or else the one file of the folder that states the task and fits.

    Args:
        tasks: Tasks in learning order.
        counts: Number of demonstrations required of each task.
        data: Image size, robot, and the files or their folder.
        progress: Whether to show a progress bar; None shows one in a terminal, and lines otherwise.
        others: Further tasks of which `data.files` may have files, such as those of a pretraining.

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
        files = _files_in(folder, [t for t in by_id.values() if t.id not in files], required, data) | files
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
    for count in sorted(set(counts), reverse=True):
        missing = [t for t in by_id.values() if required[t.id] == count and t.id not in files]
        if not missing:
            continue
        paths = ensure_demos(
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


def _named_files(
    tasks: Sequence[Task], required: Mapping[str, int], data: DataSettings, others: Sequence[Task]
) -> dict[str, Path]:
    """Return the files of `data.files`, by the id of the task that each states.

    Raises:
        DataError: One is not of a task of the run or does not fit, or two are of the same task.
    """
    files: dict[str, Path] = {}
    for path in map(Path, data.files):
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
            raise DataError(f"data.files: {path} {reason}")
        files[task.id] = path
    return files


def _files_in(
    folder: Path, tasks: Sequence[Task], required: Mapping[str, int], data: DataSettings
) -> dict[str, Path]:
    """Return the files of a folder that are used as they are, by the id of their task; say which are not, and why.

    Raises:
        DataError: Demonstrations that the expert did not record do not fit, or several files do.
    """
    files: dict[str, Path] = {}
    for task in tasks:
        file = folder / task.suite / f"{task.name}_demo.hdf5"
        if file.is_file():
            if reason := _other_task(file, task) or _misfit(file, required[task.id], data):
                raise DataError(f"data.folder: {file} {reason}")
            files[task.id] = file
    if not (left := [task for task in tasks if task.id not in files]):
        return files
    stated = _stated_tasks(folder, list(files.values()))
    for task in left:
        size = (data.image_size, data.image_size)
        own = demo_path(
            folder, DemoConfig(task, size, data.seed or 0, drawing=data.drawing, robot=data.robot)
        )
        paths = [path for path, other in stated if same_meaning(task.problem, other.problem)]
        if own in paths:
            paths.remove(own)
            if all(_recorded_by_expert(path) for path in paths):  # the recording completes its own
                continue
        reasons = {path: _misfit(path, required[task.id], data) for path in paths}
        fitting = [path for path, reason in reasons.items() if not reason]
        if len(fitting) > 1:
            several = ", ".join(map(str, fitting))
            raise DataError(
                f"data.folder has several files of {task.name!r}: {several}; name one in data.files"
            )
        if fitting:
            files[task.id] = fitting[0]
            continue
        for path, reason in reasons.items():
            if not _recorded_by_expert(path):
                raise DataError(f"data.folder: {path} {reason}")
            print(f"not used: {path} {reason}; others are recorded", file=sys.stderr)
    if stated and not files and not any(same_meaning(t.problem, o.problem) for t in left for _, o in stated):
        names = ", ".join(sorted({task.name for _, task in stated})[:3])
        print(f"data.folder has demonstrations of other tasks only, such as {names}", file=sys.stderr)
    return files


def _stated_tasks(folder: Path, used: Sequence[Path]) -> list[tuple[Path, Task]]:
    """Return the files in a folder, each with the task that it states; say which state none or are behind a link.

    Args:
        used: Files in it that are used already.
    """
    stated, links = [], []
    for path in sorted(folder.rglob("*")):
        if path.parent.suffix == ".parts" or not (path.suffix == ".hdf5" or path.is_dir()):
            continue
        if path.is_symlink():
            links += [] if any(path in (file, *file.parents) for file in used) else [str(path)]
        if path.is_symlink() or path.is_dir():
            continue
        try:
            stated.append((path, recorded_task(path)))
        except DemoError as error:
            print(f"not used: {error}", file=sys.stderr)
    if links:
        print(f"not used: links, which are not followed: {', '.join(links)}; see data.files", file=sys.stderr)
    return stated


def _recorded_by_expert(file: Path) -> bool:
    """Return whether a file is the expert's, all of it."""
    header = read_header(file)
    return str(header.get("generator", "")).startswith("scripted-expert") and "filter" not in header


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
    if data.seed is not None and header.get("seed", data.seed) != data.seed:
        return f"was recorded with seed {header['seed']}; data.seed is {data.seed}"
    models, used = json_attribute(header, "models", file).get("pack"), select_pack().name
    if models not in (None, used):
        return f"shows the models {models}; those of this run are {used}, see LIBERO_ASSETS"
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
) -> list[Path]:
    """Return the files of demonstrations as they look under perturbations; what is missing is rendered beside them.

    Args:
        paths: Demonstration file of each task, from `find_demos`.
        tasks: Tasks in the same order.
        counts: Number of demonstrations required of each task.
        perturb: Perturbations of each task.
        data: Image size and drawing.
        progress: As for `find_demos`.

    Raises:
        DemoError: A file is broken, or cannot be written.
    """
    size = (data.image_size, data.image_size)
    jobs = [
        RenderJob(path, task, n, RenderConfig(size=size, drawing=data.drawing, perturb=tuple(of_task)))
        for path, task, n, of_task in zip(paths, tasks, counts, perturb, strict=True)
    ]
    return ensure_rendered(jobs, progress=progress)


def demo_copies(
    paths: Sequence[Path],
    tasks: Sequence[Task],
    counts: Sequence[int],
    perturb: Sequence[Sequence[Perturbation]],
    data: DataSettings,
    progress: bool | None,
) -> list[tuple[Path, ...]]:
    """Return the files of further copies of each task's demonstrations, each copy under draws of its own.

    Args:
        paths: As for `perturb_demos`.
        tasks: As for `perturb_demos`.
        counts: As for `perturb_demos`.
        perturb: Perturbations of each task; those of `data` replace those of the same kind.
        data: Perturbations and number of the copies.
        progress: As for `find_demos`.

    Raises:
        DemoError: A file is broken, or cannot be written.
    """
    of_each: list[list[Path]] = []
    for number in range(data.copies):
        draws = [replace(one, seed=one.seed + number) for one in data.perturbations()]
        of_copy = [replace_perturbations(own, draws) for own in perturb]
        of_each.append(perturb_demos(paths, tasks, counts, of_copy, data, progress))
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
    """

    paths: Sequence[Path]
    counts: Sequence[int]
    spec: PolicySpec
    languages: torch.Tensor
    data: DataSettings
    device: torch.device
    copies: Sequence[Sequence[Path]] = ()
    _held: WeakValueDictionary[int, TaskWindows] = field(default_factory=WeakValueDictionary)

    def __getitem__(self, task: int) -> TaskWindows:
        dataset = self._held.get(task)
        if dataset is None:
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
