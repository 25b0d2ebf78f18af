"""Demonstrations in any number: the scripted expert in batched simulations, on all cores, resumable.

Demonstration k of a task depends on its configuration and on k alone: not on the number of workers, on what was
recorded before, or on how often the recording was interrupted.
"""

import json
import os
import sys
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout
from tqdm import tqdm

from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.demos.config import GENERATOR, DemoConfig, task_home
from libero_env.demos.hdf5 import BrokenDemoError
from libero_env.demos.record import RecordingReport, record_chunk, recorders
from libero_env.demos.write import REMEDY, DemoWriter, OtherRecordingError
from libero_env.errors import DemoError, InvalidInputError
from libero_env.parallel import check_main_guard, cpu_count, run_each, spawn_pool
from libero_env.paths import demos_dir
from libero_env.progress import progress_bar, tell_progress
from libero_env.storage import own_folder
from libero_env.tasks import Task, get_suite
from libero_env.text import counted

_NICE = 10  # of a process that records while another learns
_WAIT_SECONDS = 600.0  # between two lines about the process that is waited for


class DemoJob(ABC):
    """A demonstration file to make, of which some demonstrations may be there."""

    path: Path

    @property
    @abstractmethod
    def writer(self) -> DemoWriter:
        """Writer of the file."""

    @abstractmethod
    def missing(self, n: int) -> set[int]:
        """Return which of the first `n` demonstrations are not there.

        Raises:
            DemoError: What is there is broken, or of another configuration.
        """

    def is_complete(self, n: int) -> bool:
        """Return whether the file is finished and has the first `n` demonstrations."""
        try:
            return self.path.is_file() and not self.writer.parts.exists() and not self.missing(n)
        except DemoError:
            return False

    def discard(self, error: DemoError) -> None:
        """Remove what there is of the file, and say why."""
        reason = str(error).removesuffix(f"; {REMEDY}")
        tqdm.write(f"{reason}: recording again", file=sys.stderr)
        self.path.unlink(missing_ok=True)
        self.writer.discard_parts()


@dataclass(frozen=True)
class RecordingJob(DemoJob):
    """A demonstration file to record.

    Attributes:
        config: What its demonstrations depend on.
    """

    config: DemoConfig
    path: Path

    @cached_property
    def writer(self) -> DemoWriter:
        """Writer of the file. The first use compiles the scene."""
        return DemoWriter(self.path, self.config.header())

    def missing(self, n: int) -> set[int]:
        """Return which of the first `n` demonstrations are not recorded; see `DemoJob`."""
        return set(range(n)) - self.writer.recorded()


J = TypeVar("J", bound=DemoJob)


@contextmanager
def claim_incomplete(jobs: Iterable[tuple[J, int]]) -> Iterator[list[J]]:
    """Yield the jobs that are not complete, while no other process works in their folders.

    Args:
        jobs: Jobs, each with its number of demonstrations.
    """
    incomplete = [(job, n) for job, n in jobs if not job.is_complete(n)]
    with ExitStack() as locks:
        for folder in sorted({job.path.parent for job, _ in incomplete}):
            locks.enter_context(_recording_lock(folder))
        # another process may have finished some before the folders were locked
        yield [job for job, n in incomplete if not job.is_complete(n)]


def number_of_processes(workers: int) -> int:
    """Return a number of processes; 0 means one per core.

    Raises:
        InvalidInputError: It is negative.
    """
    if workers < 0:
        raise InvalidInputError(
            f"workers is {workers}; expected a number of processes, or 0 for one per core"
        )
    return workers or cpu_count()


def ensure_demos(
    tasks: str | Iterable[Task],
    n: int,
    *,
    camera_size: tuple[int, int] = (128, 128),
    seed: int = 0,
    drawing: str | None = None,
    root: str | Path | None = None,
    robot: str = DEFAULT_ROBOT,
    workers: int = 0,
    progress: bool | None = None,
) -> list[Path]:
    """Return demonstration files with at least `n` demonstrations of each task; what is missing is recorded.

    The path of a file contains all that its demonstrations depend on (suite, camera size, seed, generator, drawing), so
    each is recorded once. A file that was recorded with another version of the scene is recorded again. Several
    processes may call this at the same time.

    Args:
        tasks: Name of a suite, or tasks.
        n: Demonstrations of each task. The first `n` are the same however many there are.
        camera_size: (height, width) of the images, pixels.
        seed: Seed of the starts, motion styles and action noise. The 50 stored initial states are never used.
        drawing: How images are drawn, see `DemoConfig`.
        root: Folder of the demonstrations; None for `libero_env.paths.demos_dir()`.
        robot: Model of the arm, see `libero_env.assets.robot`.
        workers: Number of processes. 0 means one per core; 1 records in this process.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal, and lines otherwise.

    Returns:
        One path per task, in order.

    Raises:
        DemoError: A file cannot be written, or the expert cannot do a task.
    """
    tasks = get_suite(tasks).tasks if isinstance(tasks, str) else tuple(tasks)
    here = demos_dir() if root is None else Path(root)
    jobs = [_job(task, here, camera_size, seed, drawing, robot) for task in tasks]
    for job in jobs if root is not None else ():  # which may be somebody else's
        own_folder(here, str(job.path.parent.relative_to(here)), error=DemoError)
    reports = make_demos(jobs, n, workers=workers, progress=progress, replace=True)
    if failed := [f"{path.name}: {report.error}" for path, report in reports.items() if report.error]:
        raise DemoError(f"{len(failed)} of {len(reports)} files are not complete. {'; '.join(failed)}")
    return [job.path for job in jobs]


def _job(
    task: Task, root: Path, camera_size: tuple[int, int], seed: int, drawing: str | None, robot: str
) -> RecordingJob:
    config = DemoConfig(task, (camera_size[0], camera_size[1]), seed, drawing=drawing, robot=robot)
    return RecordingJob(config, demo_path(root, config))


class LaterDemos:
    """Records demonstrations of later tasks in a process of its own, task after task, while others are learned from.

    It gives way to other processes. As a context manager it is waited for, and killed where this one is interrupted.

    Args:
        first: Tasks of which demonstrations are needed at once.
    """

    def __init__(self, first: Iterable[Task]):
        self._first = {task.id for task in first}
        self._pool = spawn_pool(1)
        self._recorded: dict[Path, Future[list[Path]]] = {}

    def ensure(self, tasks: Sequence[Task], n: int, *, progress: bool | None, **options: Any) -> list[Path]:
        """Return demonstration files as `ensure_demos` does; those of later tasks may not be there yet."""
        ensure_demos([task for task in tasks if task.id in self._first], n, progress=progress, **options)
        root = demos_dir() if options["root"] is None else Path(options["root"])
        jobs = [_job(task, **{**options, "root": root}) for task in tasks]
        later = [job for job in jobs if job.config.task.id not in self._first and not job.is_complete(n)]
        if later and progress is not False:
            tell_progress(
                f"recording demonstrations of {counted(len(later), 'task')} while others are learned"
            )
        for job in later:
            self._recorded[job.path] = self._pool.submit(_ensure_slowly, job.config.task, n, options)
        return [job.path for job in jobs]

    @property
    def done(self) -> bool:
        """Whether all files are there."""
        return all(one.done() and not one.exception() for one in self._recorded.values())

    def wait(self, path: Path) -> None:
        """Wait until a file is there; raise a DemoError where it cannot be recorded."""
        if path in self._recorded:
            self._recorded[path].result()

    def __enter__(self) -> "LaterDemos":
        return self

    def __exit__(self, *error: Any) -> None:
        self._pool.__exit__(*error)


def _ensure_slowly(task: Task, n: int, options: dict[str, Any]) -> list[Path]:
    if hasattr(os, "nice"):
        os.nice(max(0, _NICE - os.nice(0)))
    return ensure_demos([task], n, workers=1, progress=False, **options)


def make_demos(
    jobs: Sequence[RecordingJob],
    n: int,
    *,
    workers: int = 0,
    progress: bool | None = None,
    replace: bool = False,
) -> dict[Path, RecordingReport]:
    """Record what is missing of the first `n` demonstrations of each job, all jobs in one pool of processes.

    A task that the expert cannot do does not stop the others; its report states why.

    Args:
        jobs: What to record, and into which files.
        n: Demonstrations of each job.
        workers: As for `ensure_demos`.
        progress: As for `ensure_demos`.
        replace: Whether to record again what was recorded with another configuration. Only for files whose path
            this package chose.

    Returns:
        File to report, in the order of the jobs. A file that was complete has no attempts.

    Raises:
        DemoError: An existing file was recorded with another configuration, or a file cannot be written.
    """
    workers = number_of_processes(workers)
    reports = {job.path: RecordingReport(n) for job in jobs}
    with claim_incomplete((job, n) for job in jobs) as incomplete:
        for job in incomplete if replace else ():
            try:
                job.missing(n)
            except (BrokenDemoError, OtherRecordingError) as error:  # not what cannot be opened just now
                job.discard(error)
        if incomplete:
            reports |= _record(incomplete, n, workers=workers, progress=progress)
    return reports


def demo_path(root: Path, config: DemoConfig) -> Path:
    """Return where `ensure_demos` keeps the demonstrations of a configuration; the path contains all that matters."""
    (height, width), task, options = config.camera_size, config.task, config.options()
    suffix = f"-{zlib.crc32(json.dumps(options, sort_keys=True).encode()):08x}" if options else ""
    folder = f"{height}x{width}-seed{config.seed}-{GENERATOR}{suffix}"
    return root / task_home(task) / folder / f"{task.name}_demo.hdf5"


def _record(
    jobs: Sequence[RecordingJob], n: int, *, workers: int, progress: bool | None
) -> dict[Path, RecordingReport]:
    """Record as `make_demos` does, while no other process records in the same folders."""
    missing = [sorted(job.missing(n)) for job in jobs]
    reports = {job.path: RecordingReport(n - len(m)) for job, m in zip(jobs, missing, strict=True)}
    count = sum(map(len, missing))
    share = -(-count // workers)  # what one process would record
    chunks = [
        (job, numbers[i : i + size])
        for job, numbers in zip(jobs, missing, strict=True)
        for size in [max(1, min(job.config.batch, share))]
        for i in range(0, len(numbers), size)
    ]
    if progress is not False:
        folders = ", ".join(sorted({str(job.path.parent.parent) for job in jobs}))
        tell_progress(
            f"recording {counted(count, 'demonstration')} of {counted(len(jobs), 'task')} in {folders}"
        )
    bar = progress_bar(
        total=n * len(jobs),
        initial=sum(report.recorded for report in reports.values()),
        desc="demonstrations",
        unit="demo",
        progress=progress,
    )

    def show(work: float, done: int) -> None:
        bar.add_work(work)
        bar.update(done)

    for job, numbers in zip(jobs, missing, strict=True):
        if not numbers:  # a process was killed after the last part
            job.writer.finish()
    results = run_each(
        record_chunk,
        [(job.config, job.writer, numbers) for job, numbers in chunks],
        min(workers, len(chunks)),
        lambda i: not reports[chunks[i][0].path].error,  # a job ends at its first error
        on_work=show,
    )
    with bar, closing(recorders), closing(results):
        for i, done in results:
            job = chunks[i][0]
            report = reports[job.path]
            report.add(done)
            bar.set_postfix(failed=sum(r.failure_reasons.total() for r in reports.values()), refresh=False)
            if report.recorded == n:
                job.writer.finish()
    return reports


@contextmanager
def _recording_lock(folder: Path) -> Iterator[None]:
    """Let one process at a time record or render in a folder; the lock of a process that was killed is free."""
    check_main_guard()
    lock, seconds = FileLock(folder / ".recording.lock"), 0.1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        while not lock.is_locked:  # as long as it takes; a line now and every ten minutes
            try:
                lock.acquire(timeout=seconds)
            except Timeout:
                seconds, what = _WAIT_SECONDS, f"demonstrations in {folder}"
                tell_progress(f"another process records {what}; waiting for it")
    except OSError as error:
        raise DemoError(
            f"{folder}: demonstrations cannot be recorded there ({error.strerror or error}); choose another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()
