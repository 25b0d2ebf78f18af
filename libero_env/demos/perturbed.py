"""Recorded demonstrations as they look under perturbations, rendered once and kept beside them."""

import hashlib
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from libero_env.assets.pack import select_pack
from libero_env.demos.contents import demo_names, demo_number, read_values
from libero_env.demos.generate import recording_lock
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.observe import RenderConfig
from libero_env.demos.replay import rendered_header, rerender
from libero_env.demos.write import DemoWriter
from libero_env.errors import DemoError, InvalidInputError
from libero_env.parallel import as_finished, cpu_count, progress_bar, spawn_pool
from libero_env.perturbations.value import format_perturbations
from libero_env.sim.scene import default_drawing
from libero_env.tasks import Task

_LONGEST = 120  # [characters] of the text of perturbations in the name of a folder


@dataclass(frozen=True)
class RenderJob:
    """Demonstrations to be rendered under perturbations.

    Attributes:
        file: File of the recorded demonstrations.
        task: Task that was recorded; its id names the draws.
        n: Number of demonstrations, the first of the file.
        config: What is rendered.
    """

    file: Path
    task: Task
    n: int
    config: RenderConfig

    def __post_init__(self) -> None:
        drawing = self.config.drawing or default_drawing(select_pack())
        object.__setattr__(self, "config", replace(self.config, drawing=drawing))

    @property
    def target(self) -> Path:
        """File to write: the recorded one where nothing is perturbed, or one in a folder named by the perturbations."""
        if not self.config.perturb:
            return self.file
        text, (height, width) = format_perturbations(self.config.perturbations), self.config.size
        if len(text) > _LONGEST:
            text = f"{text[:40]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        return self.file.parent / f"under-{text}-{height}x{width}-{self.config.drawing}" / self.file.name

    def is_complete(self) -> bool:
        """Return whether the file has the first `n` demonstrations, of the states that are recorded now."""
        writer = self._writer()
        try:
            return self.target.is_file() and not writer.parts.exists() and not self._missing(writer)
        except DemoError:
            return False

    def render(self) -> None:
        """Render what is missing; what is broken or was made of another file is removed before.

        Raises:
            DemoError: The recorded demonstrations are broken, or the file cannot be written.
        """
        writer = self._writer()
        try:
            self._missing(writer)
        except DemoError as error:
            tqdm.write(f"rendering again: {error}", file=sys.stderr)
            self.target.unlink(missing_ok=True)
            writer.discard_parts()
        rerender(self.file, self.target, self.config, task=self.task, limit=self.n, progress=False)

    def _missing(self, writer: DemoWriter) -> set[int]:
        """Return the numbers of the demonstrations that are to be rendered.

        Raises:
            DemoError: What is there is broken, or of other demonstrations.
        """
        rendered, missing = writer.recorded_states(), set()
        for number, states in self._states():
            if number not in rendered:
                missing.add(number)
            elif not np.array_equal(rendered[number], states):
                raise DemoError(f"{self.target} has another demo_{number} than {self.file}")
        return missing

    def _states(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the number of each recorded demonstration with its states."""
        with open_demo_file(self.file) as handle:
            for name in islice(demo_names(handle, self.file), self.n):
                states = read_values(handle["data"][name], "states", self.file, name)
                yield demo_number(name), np.zeros(0) if states is None else states

    def _writer(self) -> DemoWriter:
        return DemoWriter(self.target, rendered_header(self.file, self.config, self.task))


def ensure_rendered(
    jobs: Sequence[RenderJob], *, workers: int = 0, progress: bool | None = None
) -> list[Path]:
    """Return files of demonstrations under perturbations; what is missing is rendered.

    A job without perturbations has the recorded file. An interrupted call can be repeated, and several processes may
    call this at the same time: each file is made once.

    Args:
        jobs: What is needed.
        workers: Number of processes; 0 means one per core, 1 renders in this process.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal, and lines otherwise.

    Raises:
        DemoError: A recorded file is broken, or a file cannot be written.
    """
    if workers < 0:
        raise InvalidInputError(
            f"workers is {workers}; expected a number of processes, or 0 for one per core"
        )
    missing = _incomplete(jobs)
    with ExitStack() as locks:
        for folder in sorted({job.target.parent for job in missing}):
            locks.enter_context(recording_lock(folder))
        # another process may have rendered some before the folders were locked
        missing = _incomplete(missing)
        if missing:
            _render(missing, min(workers or cpu_count(), len(missing)), progress)
    return [job.target for job in jobs]


def _incomplete(jobs: Sequence[RenderJob]) -> list[RenderJob]:
    """Return the jobs that are not done, each file once: with the most demonstrations that are asked for."""
    largest: dict[Path, RenderJob] = {}
    for job in jobs:
        if job.config.perturb and (job.target not in largest or largest[job.target].n < job.n):
            largest[job.target] = job
    return [job for job in largest.values() if not job.is_complete()]


def _render(jobs: Sequence[RenderJob], workers: int, progress: bool | None) -> None:
    """Render jobs while no other process writes in their folders."""
    if progress is not False:
        folders = ", ".join(sorted({str(job.target.parent) for job in jobs}))
        tqdm.write(f"rendering demonstrations of {len(jobs)} tasks in {folders}", file=sys.stderr)
    bar = progress_bar(total=len(jobs), desc="render", unit="file", progress=progress)
    with bar, ExitStack() as stack:
        if workers < 2:
            for job in jobs:
                job.render()
                bar.update(1)
            return
        pool = stack.enter_context(spawn_pool(workers))
        futures: list[Future[None]] = [pool.submit(job.render) for job in jobs]
        for future in as_finished(futures):
            future.result()
            bar.update(1)
