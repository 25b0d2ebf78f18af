"""Demonstrations of a run's tasks: recorded if there are none, read when they are needed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from weakref import WeakValueDictionary

import torch

from libero_env.demos.config import RenderConfig
from libero_env.demos.generate import ensure_demos
from libero_env.demos.read import demo_lengths
from libero_env.demos.rendering import RenderJob, ensure_rendered
from libero_env.perturbations import Perturbation, replace_perturbations
from libero_env.tasks import Task
from libero_env.text import closest
from lifelong.data import DemoSource, open_windows
from lifelong.data.settings import DataSettings
from lifelong.data.windows import StageWindows, TaskWindows
from lifelong.errors import DataError
from lifelong.types import PolicySpec


def find_demos(
    tasks: Sequence[Task], counts: Sequence[int], data: DataSettings, progress: bool | None
) -> list[Path]:
    """Return the demonstration file of each task; missing demonstrations are recorded.

    If `data.folder` is set and has a file `<suite>/<task>_demo.hdf5`, the layout of the original's data sets, that file
    is used.

    Args:
        tasks: Tasks in learning order.
        counts: Number of demonstrations required of each task.
        data: Image size, robot, and the folder of the files.
        progress: Whether to show a progress bar; None shows one in a terminal, and lines otherwise.

    Raises:
        DataError: `data.folder` does not exist, or a file in the original's layout has fewer demonstrations than
            required.
        DemoError: A file is broken, or demonstrations cannot be recorded.
    """
    folder, files = check_folder(data), dict[str, Path]()
    for task, count in zip(tasks, counts, strict=True) if folder else ():
        file = Path(folder or "") / task.suite / f"{task.name}_demo.hdf5"
        if file.is_file():
            available = len(demo_lengths(file, count))
            if available < count:
                raise DataError(
                    f"{file} has {available} demonstrations and {count} are required; use data.demos={available}"
                )
            files[task.id] = file
    for count in sorted(set(counts), reverse=True):
        missing = [t for t, n in zip(tasks, counts, strict=True) if n == count and t.id not in files]
        if not missing:
            continue
        paths = ensure_demos(
            missing,
            count,
            camera_size=(data.image_size, data.image_size),
            drawing=data.drawing,
            root=folder,
            robot=data.robot,
            progress=progress,
        )
        files |= zip([task.id for task in missing], paths, strict=True)
    return [files[task.id] for task in tasks]


def check_folder(data: DataSettings) -> Path | None:
    """Return the folder of the demonstrations, None for the default one.

    Raises:
        DataError: It does not exist; the message names a similar folder beside it.
    """
    if data.folder is None:
        return None
    folder = Path(data.folder).expanduser()
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
    copies_of_each: list[tuple[Path, ...]] = [()] * len(paths)
    for number in range(data.copies):
        draws = [replace(one, seed=one.seed + number) for one in data.perturbations()]
        of_copy = [replace_perturbations(own, draws) for own in perturb]
        files = perturb_demos(paths, tasks, counts, of_copy, data, progress)
        copies_of_each = [(*copies, file) for copies, file in zip(copies_of_each, files, strict=True)]
    return copies_of_each


@dataclass(frozen=True)
class DemoDatasets(Mapping[int, TaskWindows]):
    """The windows of each task, by position; they are read when requested and kept while something refers to them.

    Attributes:
        paths: Demonstration file of each task.
        counts: Number of demonstrations of each task.
        spec: Views, readings and their sizes.
        languages: Embeddings of the instructions, (K, L) for K tasks.
        data: How the files are read, and where frames are held.
        device: Device of the batches.
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
            source,
            language=self.languages[task],
            task_id=task,
            device=self.device,
            memory=self.data.memory,
        )

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.paths)))

    def __len__(self) -> int:
        return len(self.paths)
