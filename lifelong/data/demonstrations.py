"""Demonstrations of a run's tasks: made where there are none, read when asked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from weakref import WeakValueDictionary

import torch

from libero_env.demos.generate import ensure_demos
from libero_env.demos.read import demo_lengths
from libero_env.tasks import Task
from lifelong.data import DemoSource, open_windows
from lifelong.data.memory import TaskWindows
from lifelong.data.settings import DataSettings
from lifelong.errors import DataError
from lifelong.types import PolicySpec


def find_demos(
    tasks: Sequence[Task], counts: Sequence[int], data: DataSettings, progress: bool
) -> list[Path]:
    """The demonstration file of each task; recorded now where there is none.

    A file `<folder>/<suite>/<task>_demo.hdf5`, as the original's are laid out, goes before ours where the folder is
    named.

    Args:
        tasks: In learning order.
        counts: Demonstrations needed of each.
        data: Size of the pictures, and the folder of the files.
        progress: Show a bar.

    Raises:
        DataError: A file laid out like that has fewer.
    """
    found = dict(_laid_out(tasks, counts, data))
    for count in sorted(set(counts), reverse=True):
        wanted = [t for t, n in zip(tasks, counts, strict=True) if n == count and t.id not in found]
        if not wanted:
            continue
        size = (data.image_size, data.image_size)
        paths = ensure_demos(wanted, count, camera_size=size, root=data.folder, progress=progress)
        found |= zip([task.id for task in wanted], paths, strict=True)
    return [found[task.id] for task in tasks]


def _laid_out(tasks: Sequence[Task], counts: Sequence[int], data: DataSettings) -> Iterator[tuple[str, Path]]:
    """Files in the original's layout, by task."""
    for task, count in zip(tasks, counts, strict=True) if data.folder else ():
        file = Path(data.folder or "").expanduser() / task.suite / f"{task.name}_demo.hdf5"
        if file.is_file():
            there = len(demo_lengths(file, count))
            if there < count:
                raise DataError(
                    f"{file} has {there} demonstrations and {count} are wanted; use data.demos={there}"
                )
            yield task.id, file


@dataclass(frozen=True)
class DemoDatasets(Mapping[int, TaskWindows]):
    """The tasks' windows by position; read when asked for, and kept for as long as somebody holds them."""

    paths: Sequence[Path]
    counts: Sequence[int]  # demonstrations of each
    spec: PolicySpec
    languages: torch.Tensor  # (K, L)
    data: DataSettings
    device: torch.device
    _held: WeakValueDictionary[int, TaskWindows] = field(default_factory=WeakValueDictionary)

    def __getitem__(self, task: int) -> TaskWindows:
        dataset = self._held.get(task)
        if dataset is None:
            source = DemoSource(
                self.paths[task], self.spec, self.counts[task], self.data.pairing, self.data.labels
            )
            dataset = self._held[task] = open_windows(
                source,
                language=self.languages[task],
                task_id=task,
                device=self.device,
                memory=self.data.memory,
                backend=self.data.backend,
            )
        return dataset

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.paths)))

    def __len__(self) -> int:
        return len(self.paths)
