"""Making demonstrations: the scripted expert in batched simulations, on all cores, resumable.

Demonstration k of a task depends on the seed and k alone (and on what the file says it was made with): not on the
number of workers, on what was recorded before, or on how often the recording was interrupted.
"""

import shutil
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import replace as changed
from pathlib import Path

from filelock import FileLock, Timeout
from tqdm import tqdm

from libero_env.demos.read import Pairing
from libero_env.demos.record import BATCH, GENERATOR, Recipe, Tally, record_chunk
from libero_env.demos.write import DemoWriter
from libero_env.errors import DemoError
from libero_env.parallel import cpu_count, spawn_pool
from libero_env.paths import demos_dir
from libero_env.tasks import Task, get_suite


def generate(
    task: Task | str,
    n: int,
    *,
    path: str | Path,
    seed: int = 0,
    camera_size: tuple[int, int] = (128, 128),
    workers: int = 0,
    pairing: Pairing = "aligned",
    disturb: bool = True,
    progress: bool | None = None,
) -> Path:
    """Record the first `n` demonstrations of a task into one file; those that are there already stay.

    `make_demos` takes a whole `Recipe`: other cameras, depth, variation.

    Args:
        task: a `Task`, what `get_task` takes, or a BDDL file.
        n: number of successful demonstrations; failed attempts are left out and counted in the file.
        path: the file. An interrupted recording leaves `<path>.parts`, and goes on when called again.
        seed: of placements, manners and disturbances. The 50 stored initial states are never used.
        camera_size: (height, width), pixels.
        workers: processes; 0 is one for each core, 1 records in this process.
        pairing: see `libero_env.demos.read`.
        disturb: disturb the executed actions; the file then also holds what the expert wanted.
        progress: show a bar; None where stderr is a terminal.

    Raises:
        DemoError: the file there was made otherwise, cannot be written, or the expert cannot do the task.
    """
    recipe = Recipe(Recipe(task).task, (camera_size[0], camera_size[1]), seed, pairing, disturb)
    path = Path(path)
    _refuse_failures(make_demos([(recipe, path)], n, workers=workers, progress=progress))
    return path


def ensure_demos(
    tasks: str | Iterable[Task],
    n: int,
    *,
    camera_size: tuple[int, int] = (128, 128),
    seed: int = 0,
    root: str | Path | None = None,
    workers: int = 0,
    progress: bool | None = None,
) -> list[Path]:
    """Demonstration files with at least `n` demonstrations for each task: found where they are, else recorded.

    Files are named by all that matters (suite, camera size, seed, generator), so that each is made once; one that was
    recorded with another version of the scene is recorded anew. Several processes may call this at once.

    Args:
        tasks: name of a suite, or tasks.
        n: demonstrations of each; the first `n` are the same however many there are.
        camera_size, seed, workers, progress: as for `generate`.
        root: folder of demonstrations; `libero_env.paths.demos_dir()` by default.

    Returns:
        One path for each task, in order.
    """
    tasks = get_suite(tasks).tasks if isinstance(tasks, str) else tuple(tasks)
    root = demos_dir() if root is None else Path(root)
    jobs = [
        (r, demo_path(root, r)) for r in (Recipe(t, (camera_size[0], camera_size[1]), seed) for t in tasks)
    ]
    _refuse_failures(make_demos(jobs, n, workers=workers, progress=progress, replace=True))
    return [path for _, path in jobs]


def make_demos(
    jobs: Sequence[tuple[Recipe, Path]],
    n: int,
    *,
    workers: int = 0,
    progress: bool | None = None,
    replace: bool = False,
) -> dict[Path, Tally]:
    """Record what is missing of the first `n` demonstrations of each job, all jobs on one pool of processes.

    A task that the expert cannot do stops nothing else; its tally says why.

    Args:
        jobs: what to record, and into which file.
        n: demonstrations of each.
        workers, progress: as for `generate`.
        replace: record again what was made otherwise; only for files that this package named itself.

    Returns:
        File -> what came of it, in the order of the jobs; no attempts where all was there.

    Raises:
        DemoError: a file there was made otherwise, or one cannot be written.
    """
    tallies = {path: Tally(n) for _, path in jobs}
    missing = [job for job in jobs if not _complete(*job, n)]
    folders = sorted({path.parent for _, path in missing})
    with ExitStack() as locks:
        for folder in folders:
            locks.enter_context(_locked(folder))
        missing = [job for job in missing if not _complete(*job, n)]
        for recipe, path in missing if replace else ():
            _make_way(DemoWriter(path, recipe.header()))
        if missing:
            tallies |= record(missing, n, workers=workers, progress=progress)
    return tallies


def _refuse_failures(tallies: dict[Path, Tally]) -> None:
    failed = {path: tally for path, tally in tallies.items() if tally.error}
    if failed:
        each = "; ".join(f"{path.name}: {tally.error}" for path, tally in failed.items())
        raise DemoError(f"{len(failed)} of {len(tallies)} files are not complete. {each}")


def demo_path(root: Path, recipe: Recipe) -> Path:
    """Where `ensure_demos` keeps the demonstrations of a recipe: named by all that matters."""
    (height, width), task = recipe.camera_size, recipe.task
    usual = Recipe(recipe.source, recipe.camera_size, recipe.seed)
    more = "" if recipe == usual else f"-{zlib.crc32(repr(changed(recipe, source='')).encode()):08x}"
    return (
        root / task.suite / f"{height}x{width}-seed{recipe.seed}-{GENERATOR}{more}" / f"{task.name}_demo.hdf5"
    )


def record(
    jobs: Sequence[tuple[Recipe, Path]], n: int, *, workers: int = 0, progress: bool | None = None
) -> dict[Path, Tally]:
    """As `make_demos`, without a look at what other processes do."""
    writers = [DemoWriter(path, recipe.header()) for recipe, path in jobs]
    missing = [sorted(set(range(n)) - writer.recorded()) for writer in writers]
    tallies = [Tally(n - len(numbers)) for numbers in missing]
    chunks = [
        (j, numbers[i : i + BATCH])
        for j, numbers in enumerate(missing)
        for i in range(0, len(numbers), BATCH)
    ]
    bar = tqdm(
        total=n * len(jobs),
        initial=sum(tally.recorded for tally in tallies),
        desc="demonstrations",
        unit="demo",
        smoothing=0.1,
        disable=None if progress is None else not progress,
    )
    with bar:
        done = _run(
            [(*jobs[j], numbers) for j, numbers in chunks], [j for j, _ in chunks], workers or cpu_count()
        )
        for j, tally in done:
            tallies[j].add(tally)
            bar.update(tally.recorded)
            bar.set_postfix(failed=sum(t.reasons.total() for t in tallies), refresh=False)
            if tallies[j].recorded == n:
                writers[j].finish()
    return {path: tally for (_, path), tally in zip(jobs, tallies, strict=True)}


def _run(
    chunks: list[tuple[Recipe, Path, list[int]]], owners: list[int], workers: int
) -> Iterator[tuple[int, Tally]]:
    """Record chunks in processes; yields (owner, tally) as each is done. Chunks of an owner that has failed are left
    out, as far as they have not begun."""
    workers, failed = min(workers, len(chunks)), set()
    if workers <= 1:
        for owner, chunk in zip(owners, chunks, strict=True):
            if owner not in failed:
                tally = record_chunk(*chunk)
                failed |= {owner} if tally.error else set()
                yield owner, tally
        return
    pool = spawn_pool(workers)
    futures: dict[Future[Tally], int] = {}
    try:
        for owner, chunk in zip(owners, chunks, strict=True):
            futures[pool.submit(record_chunk, *chunk)] = owner
        for future in as_completed(futures):
            if future.cancelled():
                continue
            tally, owner = future.result(), futures[future]
            if tally.error:
                for other in [other for other, whose in futures.items() if whose == owner]:
                    other.cancel()
            yield owner, tally
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _complete(recipe: Recipe, path: Path, n: int) -> bool:
    """Whether the file has the first `n` demonstrations of the recipe."""
    writer = DemoWriter(path, recipe.header())
    try:
        return path.is_file() and not writer.parts.exists() and set(range(n)) <= writer.recorded()
    except DemoError:
        return False


def _make_way(writer: DemoWriter) -> None:
    """Remove what an older version of the scene or the expert left under the name of the file to be, or a broken one.
    Only for files that this package named itself."""
    try:
        writer.recorded()
    except DemoError as error:
        tqdm.write(f"recording again: {error}")
        writer.path.unlink(missing_ok=True)
        shutil.rmtree(writer.parts, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One recording at a time in a folder; the lock of a process that was killed is free."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".recording.lock")
    try:
        lock.acquire(timeout=0.1)
    except Timeout:
        tqdm.write(f"another process records demonstrations in {folder}; waiting for it")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()
