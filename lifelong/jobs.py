"""From a command line that is checked to runs: jobs are run by Hydra, errors take one line, sweeps get a report."""

import argparse
import io
import math
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from copy import copy
from pathlib import Path
from typing import Any, TextIO

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from libero_env.cli import ending
from libero_env.errors import LiberoError
from libero_env.parallel import end_with_parent, limit_first_picture
from libero_env.text import printable
from lifelong import experiment
from lifelong.composition import REFUSALS, check_obeyed, explained, swept
from lifelong.report.comparison import Plan
from lifelong.report.page import comparison_text, write_report
from lifelong.results.provenance import config_digest
from lifelong.settings import plain_data
from lifelong.sweeps import (
    FOLDER,
    JOB_FILE,
    JobRecord,
    begin_sweep,
    job_suffix,
    read_sweep,
    run_job,
    status_lines,
    sweep_name,
)
from lifelong.training.distributed import Ranks, process_group, rank


def launch(options: argparse.Namespace, config: DictConfig, folders: Sequence[Path]) -> int:
    """Run the jobs of a command line, several after `-m`; return the worst exit status.

    Args:
        options: Options and overrides, see `lifelong.launch.read_options`.
        config: Configuration of the first job, from `lifelong.composition.compose_first`.
        folders: Folders of configuration files.
    """
    with process_group() as ranks:
        try:
            return _launch(options, config, list(folders), ranks)
        except Exception as error:  # noqa: BLE001 - told by kind
            return _report(error)


def _launch(options: argparse.Namespace, config: DictConfig, folders: list[Path], ranks: Ranks) -> int:
    words, sweep = list(options.overrides), None
    lists = swept(words, folders)
    job = Job(ranks, [word for word in words if not word.startswith("hydra")], folders)
    if options.multirun:
        folder = config.hydra.sweep.dir
        if not any(word.startswith("hydra.sweep.dir=") for word in words):
            # a folder of its own, by which the same command finds it again
            folder = f"{Path(config.runs_dir).expanduser()}/{FOLDER}/{sweep_name(sorted(words), list(lists))}"
            words.append(f"hydra.sweep.dir='{folder}'")
        sweep = Path(folder).resolve()
        jobs = math.prod(map(len, lists.values()))
        # another sweeper chooses as it goes, so that their number is not known
        chooses = "BasicSweeper" not in config.hydra.sweeper._target_
        if ranks.first and not (options.cfg or options.info):
            begin_sweep(sweep, job.words, None if chooses else jobs)
            print(f"a sweep, in {sweep}: libero sweep status {sweep} says how far it is", flush=True)
    sys.argv[1:] = [*options.chosen, *words]  # where Hydra reads them; overrides stand at the end
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach the caller, which prints a line
    try:
        hydra.main(version_base="1.3", config_path=str(folders[0]), config_name="config")(job)()
        if options.cfg == "job":  # what is shown may be what a run refuses
            with open_dict(config):
                del config["hydra"]
            experiment.check(config)
    except LiberoError:
        raise
    except REFUSALS as error:  # of Hydra: jobs keep theirs
        raise explained(error, words, folders) from error
    except Exception:
        if sweep is not None:
            _end_sweep(sweep, ranks)  # a launcher lost a job, such as one that its cluster has killed
        raise
    return job.status if sweep is None else _end_sweep(sweep, ranks)


class Job:
    """What Hydra calls for each job, with its configuration: in this process, or a copy in one of a launcher's.

    Args:
        ranks: Ranks of this process.
        words: Overrides of the whole command.
        folders: Folders of configuration files.
    """

    def __init__(self, ranks: Ranks, words: list[str], folders: list[Path]):
        self.ranks: Ranks | None = ranks
        self.words, self.folders, self.status = words, folders, 0

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "ranks": None}  # a launcher's process joins those it trains with by itself

    def __call__(self, config: DictConfig) -> Path | None:
        """Run the job; return the run's directory, None after an error."""
        if self.ranks is not None:
            return self._run(config, self.ranks)
        end_with_parent()
        limit_first_picture(told_here=True)
        with ending.interruptible(), process_group() as ranks:
            return self._run(config, ranks)

    def _run(self, config: DictConfig, ranks: Ranks) -> Path | None:
        hydra_config = HydraConfig.get()
        # as they were typed, with their interpolations
        words: Any = OmegaConf.to_container(hydra_config.overrides.task)
        if hydra_config.mode == RunMode.MULTIRUN:
            config = self._named(config, words)
            own = [word for word in words if word.partition("=")[0] in swept(self.words)]
            planned = read_sweep(Path(hydra_config.sweep.dir)).planned
            name = " ".join([f"{hydra_config.job.num + 1}/{planned or '…'}", *own])
            with (
                redirect_stdout(_Named(sys.stdout, f"[{name}] ")),
                redirect_stderr(_Named(sys.stderr, f"[{name}] ")),
            ):
                return self._learn(config, hydra_config, words, ranks)
        return self._learn(config, hydra_config, words, ranks)

    def _learn(self, config: DictConfig, hydra_config: Any, words: list[str], ranks: Ranks) -> Path | None:
        choices = hydra_config.runtime.choices

        def learn() -> Path:
            check_obeyed(config, choices, words, self.folders, swept(self.words, self.folders))
            return experiment.run(config, choices, ranks, words)

        if hydra_config.mode != RunMode.MULTIRUN or not ranks.first:
            try:
                return learn()
            except Exception as error:  # noqa: BLE001 - told by kind
                self.status = _report(error)
                if ranks.size > 1:  # the others may be waiting: torchrun ends them when this process ends
                    raise SystemExit(self.status) from error
                return None
        file = Path(hydra_config.runtime.output_dir) / JOB_FILE
        # a run of another name is another one
        plain = experiment.with_chosen(plain_data(config))
        key = config_digest({**plain, "run": [config.runs_dir, config.run_id]})
        record = JobRecord(int(hydra_config.job.num), key, tuple(words), "running")
        # a finished run returns at once, or is evaluated under another shift
        again = ranks.size > 1 or not config.resume or config.eval.shift is not None
        done = run_job(file, record, learn, _report_line, again=again)
        if done.exit_status and ranks.size > 1:
            raise SystemExit(done.exit_status)
        return Path(done.run) if done.run else None

    def _named(self, config: DictConfig, overrides: Sequence[str]) -> DictConfig:
        """Return a job's configuration with a `run_id` that tells its run from those of the sweep's other jobs."""
        several, named = swept(self.words), {word.partition("=")[0] for word in self.words}
        values = {key: value for key, _, value in (word.partition("=") for word in overrides)}
        name = job_suffix({k: value for k, value in values.items() if k in several or k not in named})
        if not name:
            return config
        config = copy(config)
        config.run_id = name if config.run_id is None else f"{config.run_id}_{name}"
        return config


class _Named(io.TextIOBase):
    """A stream whose lines begin with a name, as those of jobs that run side by side.

    Args:
        stream: Stream that is written to. It counts as no terminal, so that progress is told in lines.
        name: What each line begins with.
    """

    def __init__(self, stream: TextIO, name: str):
        self._stream, self._name, self._fresh = stream, name, True

    def write(self, text: str) -> int:
        """Write text, of which each line gets the name once."""
        if text:
            body = text[:-1].replace("\n", f"\n{self._name}") + text[-1]
            self._stream.write(self._name * self._fresh + body)
            self._fresh = text.endswith("\n")
        return len(text)

    def flush(self) -> None:
        """Write out what the stream has kept."""
        self._stream.flush()

    def fileno(self) -> int:
        """Return the number of the stream's file, for processes that are given it."""
        return self._stream.fileno()


def _end_sweep(folder: Path, ranks: Ranks) -> int:
    """Say what became of the jobs, compare the runs that are finished, and return the exit status."""
    if not ranks.first or not folder.is_dir():
        return 0
    sweep = read_sweep(folder)
    if len(sweep.runs) > 1:
        page = write_report(sweep.runs, sweep.folder / "report.html", Plan(other_worlds=True))
        print("\n".join([f"{len(sweep.runs)} runs compared: {page}", *comparison_text(page)]))
    if sweep.exit_status:
        print("\n".join(status_lines(sweep)), file=sys.stderr)
    return sweep.exit_status


def _report_line(error: BaseException) -> tuple[int, str]:
    """Print an error; return the exit status and the error in one line."""
    cause = _cause(error)
    text = " ".join(str(cause).split()) or type(cause).__name__
    named = text if isinstance(cause, LiberoError) else f"{type(cause).__name__}: {text}"
    return _report(error), printable(named)


def _report(error: BaseException) -> int:
    """Print an error in one line; where Hydra wraps an error of ours, the message of ours."""
    who = f"rank {rank()}: " if rank() else ""
    return ending.report(_cause(error), who=who, mistakes=(HydraException, OmegaConfBaseException))


def _cause(error: BaseException) -> BaseException:
    """Return the error of ours that caused another one, or that one."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, LiberoError):
        cause = cause.__cause__
    return cause or error
