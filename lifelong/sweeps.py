"""Sweeps: what became of each job is kept in a file, whatever process or machine ran it.

Hydra's launchers run the jobs of a sweep (`-m`) in this process, in others, or on other machines, to which functions
and callbacks are copied: what a job returns or a callback collects may never come back. So each job keeps a record, and
the process that started the sweep reads them all. A sweep that is started again runs what is missing.

    <runs_dir>/sweep/<name>/sweep.json             what was asked: the words of the command, the number of jobs
    <runs_dir>/sweep/<name>/jobs/<number>/job.json what became of a job
    <runs_dir>/sweep/<name>/report.html            the runs that are finished, compared
"""

import hashlib
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from filelock import FileLock, Timeout
from pydantic import Field

from libero_env.parallel import this_process
from libero_env.storage import read_json, write_json
from libero_env.text import duration
from libero_env.validation import validate
from lifelong.errors import ResultsError, RunLockedError, writing
from lifelong.results.provenance import utc_now

SWEEP_FILE, JOB_FILE, FOLDER = "sweep.json", "job.json", "sweep"
Status = Literal["done", "running", "failed", "interrupted", "lost"]
# values that the name of every run has; and one run is evaluated under several shifts
IN_NAME = ("seed", "algo", "policy", "benchmark", "run_id", "eval.shift")
_LONGEST = 60  # characters of what a sweep adds to a run's name
_POLL = 5.0  # s between two looks at a run that another process writes


@dataclass(frozen=True)
class JobRecord:
    """What became of a job.

    Attributes:
        number: Number of the job in the sweep, from 0.
        key: Digest of what its results depend on.
        words: Its overrides of the configuration.
        status: `running`; `done`; `failed`, with an error; `interrupted`, by a signal; `lost`: it ended without a word.
        process: Machine and number of the process.
        started: When it began, UTC.
        seconds: Time that it took, [s].
        run: Directory of the run; None before there is one.
        error: The error in one line.
        exit_status: Exit status that the error calls for; 0 without one.
    """

    number: int
    key: str
    words: tuple[str, ...]
    status: Status
    process: str = field(default_factory=this_process)
    started: str = field(default_factory=utc_now)
    seconds: float = 0.0
    run: str | None = None
    error: str | None = None
    exit_status: Annotated[int, Field(ge=0, le=255)] = 0

    @property
    def is_finished(self) -> bool:
        """Whether it is done, and its run is still there."""
        return self.status == "done" and self.run is not None and (Path(self.run) / "results.json").is_file()


@dataclass(frozen=True)
class Sweep:
    """A sweep as its folder tells it.

    Attributes:
        words: Words of the command.
        planned: Number of jobs; None where the sweeper chooses them as it goes.
        jobs: Records, by number.
    """

    folder: Path
    words: tuple[str, ...]
    planned: int | None
    jobs: tuple[JobRecord, ...]

    @property
    def runs(self) -> list[Path]:
        """Directories of the finished runs."""
        return list(dict.fromkeys(Path(job.run) for job in self.jobs if job.is_finished and job.run))

    @property
    def missing(self) -> int:
        """Number of jobs that have not begun."""
        return max(0, (self.planned or 0) - len(self.jobs))

    @property
    def exit_status(self) -> int:
        """Exit status of the sweep: the worst of its jobs; 1 where one has not ended."""
        unfinished = self.missing or any(
            job.status in ("running", "interrupted", "lost") for job in self.jobs
        )
        return max([*(job.exit_status for job in self.jobs), int(bool(unfinished))], default=0)


def sweep_name(words: Sequence[str], swept: Sequence[str]) -> str:
    """Return the name of a sweep's folder: the same command goes on in the same folder.

    Args:
        words: Words of the command.
        swept: Keys of which several values are tried.
    """
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
    keys = "_".join(map(_last, swept))[:60]
    return f"{keys}-{digest}" if keys else digest


def job_suffix(own: Mapping[str, str]) -> str:
    """Return what tells the run of a job from those of the other jobs, as in `lr1e-3_epochs20`.

    Args:
        own: Overrides of the job that others of the sweep have with other values, key -> value.
    """
    told = {key: value for key, value in own.items() if key not in IN_NAME and not key.startswith("hydra.")}
    lasts, words = [_last(key) for key in told], []
    for key, value in sorted(told.items()):
        name = _last(key) if lasts.count(_last(key)) == 1 else key
        words.append(f"{name}{'-' if value[:1].isalpha() else ''}{value}")
    text = re.sub(r"[^\w.+-]+", "-", "_".join(words)).strip("-._+")
    digest = hashlib.sha256(repr(sorted(told.items())).encode()).hexdigest()[:8]
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 9]}-{digest}"


def _last(key: str) -> str:
    return key.lstrip("+").rpartition(".")[2].rpartition("/")[2]


def begin_sweep(folder: Path, words: Sequence[str], planned: int | None) -> None:
    """Write what is asked; where another command had the folder, the records of its jobs are removed.

    Raises:
        ResultsError: The folder cannot be written, or a file is broken.
    """
    file, content = folder / SWEEP_FILE, {"words": list(words), "planned": planned}
    with writing(folder, "the sweep"):
        if file.is_file() and not content.items() <= _read_json(file).items():
            for job in (folder / "jobs").glob(f"*/{JOB_FILE}"):
                job.unlink()
        write_json(file, {**content, "started": utc_now()})


def read_sweep(folder: Path) -> Sweep:
    """Read a sweep.

    Raises:
        ResultsError: It is not the folder of a sweep, or a file is broken.
    """
    file = folder / SWEEP_FILE
    if not file.is_file():
        raise ResultsError(f"{folder} is not the folder of a sweep: it has no {SWEEP_FILE}")
    content = _read_json(file)
    words, planned = content.get("words", []), content.get("planned")
    jobs = [job for path in (folder / "jobs").glob(f"*/{JOB_FILE}") if (job := read_job(path))]
    return Sweep(folder, tuple(words), planned, tuple(sorted(jobs, key=lambda job: job.number)))


def find_sweeps(folder: Path) -> list[Path]:
    """Return the folder if it is one of a sweep, or those of the sweeps in a folder of runs."""
    if (folder / SWEEP_FILE).is_file():
        return [folder]
    found = [*folder.glob(f"*/{SWEEP_FILE}"), *folder.glob(f"{FOLDER}/*/{SWEEP_FILE}")]
    return sorted(file.parent for file in found)


def read_job(file: Path) -> JobRecord | None:
    """Return the record of a job; None if there is none.

    Raises:
        ResultsError: The file is broken.
    """
    if not file.is_file():
        return None
    known = {key: value for key, value in _read_json(file).items() if key in JobRecord.__dataclass_fields__}
    job: JobRecord = validate(JobRecord, known, prefix=(str(file),), error=ResultsError)
    return replace(job, status="lost") if job.status == "running" and not _is_locked(file) else job


def run_job(
    file: Path,
    job: JobRecord,
    learn: Callable[[], Path],
    report: Callable[[BaseException], tuple[int, str]],
    *,
    again: bool = False,
) -> JobRecord:
    """Run a job and keep its record; one that is done already is not run again.

    Where another process writes the same run, such as a job of an earlier start of the sweep that goes on elsewhere, it
    is waited for.

    Args:
        job: The job, running.
        learn: Function that learns and returns the directory of the run.
        report: Function that prints an error and returns the exit status and the line.
        again: Whether to call `learn` also for a job that is done, as where other processes learn along.

    Returns:
        The record at the end. Errors of the job are kept in it.

    Raises:
        KeyboardInterrupt: The job was interrupted, which is kept, too.
    """
    earlier = read_job(file)
    if not again and earlier is not None and earlier.key == job.key and earlier.is_finished:
        print(f"job {job.number} is done: {earlier.run}", flush=True)
        return earlier
    began = time.monotonic()

    def ended(status: Status, **more: Any) -> JobRecord:
        record = replace(job, status=status, seconds=round(time.monotonic() - began, 1), **more)
        _write(file, record)
        return record

    lock = FileLock(file.with_suffix(".lock"))
    try:
        with writing(file, "the record of the job"):
            file.parent.mkdir(parents=True, exist_ok=True)
            with suppress(Timeout):  # another start of the sweep has the job, and its run
                lock.acquire(timeout=0)
        _write(file, job)
        path = _when_free(learn)
    except (KeyboardInterrupt, SystemExit) as error:
        ended("interrupted", error=type(error).__name__)
        raise
    except Exception as error:  # noqa: BLE001 - told by kind; the other jobs of a sweep go on
        status, line = report(error)
        return ended("failed", error=line, exit_status=status)
    else:
        return ended("done", run=str(path.resolve()))
    finally:
        lock.release()


def status_lines(sweep: Sweep) -> Iterator[str]:
    """Yield the lines that say how far a sweep is: what runs, what failed, and what is left."""
    counts = {name: sum(job.status == name for job in sweep.jobs) for name in get_args(Status)}
    told = [f"{count} {name}" for name, count in counts.items() if count]
    told += [f"{sweep.missing} not begun"] if sweep.missing else []
    of = "" if sweep.planned is None else f" of {sweep.planned} jobs"
    yield f"{sweep.folder}: {', '.join(told) or 'nothing begun'}{of}"
    common = set.intersection(*(set(job.words) for job in sweep.jobs)) if len(sweep.jobs) > 1 else set()
    for job in sweep.jobs:
        own = " ".join(word for word in job.words if word not in common)
        took = "" if job.status in ("running", "lost") else duration(job.seconds)
        line = f"{job.number:>4}  {job.status:<11}  {took:>11}  {own}"
        if job.status in ("running", "lost"):
            line += f"  ({job.process})"
        yield line + (f"\n      {job.error}" if job.error else "")


def _when_free(learn: Callable[[], Path]) -> Path:
    """Learn; while another process writes the run, wait."""
    told = False
    while True:
        try:
            return learn()
        except RunLockedError as error:
            if not told:
                print(f"{error}; waiting for it", flush=True)
                told = True
            time.sleep(_POLL)


def _is_locked(file: Path) -> bool:
    """Return whether the process that runs a job still does."""
    lock = FileLock(file.with_suffix(".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return True
    lock.release()
    return False


def _write(file: Path, job: JobRecord) -> None:
    with writing(file, "the record of the job"):
        write_json(file, asdict(job))


def _read_json(file: Path) -> dict[str, Any]:
    content = read_json(file, ResultsError)
    if not isinstance(content, dict):
        raise ResultsError(f"{file} is no record of a sweep; remove it to run its job again")
    return content
