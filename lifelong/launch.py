"""From the command line to a run: jobs are run by Hydra, errors take one line, sweeps get a report."""

import argparse
import math
import os
import sys
from collections.abc import Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from libero_env.cli import ending
from libero_env.errors import LiberoError
from libero_env.parallel import end_with_parent
from libero_env.text import printable
from lifelong import experiment
from lifelong.composition import (
    check_choices,
    check_overrides,
    config_folder,
    existing_folder,
    in_order,
    read_options,
    swept,
    with_suggestion,
)
from lifelong.errors import ConfigError
from lifelong.report.page import write_report
from lifelong.results.run_directory import config_digest
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

# of the process that was started: its ranks, folders of configuration files, and sweep
_process: dict[str, Any] = {}


class SweepStart(Callback):
    """Hydra callback that notes what a sweep (`-m`) is asked for, in the process that starts it."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the sweep's file."""
        folder = Path(config.hydra.sweep.dir).resolve()
        words, ranks = list(config.hydra.overrides.task), _process.get("ranks") or Ranks()
        planned = math.prod(len(values) for values in swept(words, _process.get("folders", ())).values())
        own = "BasicSweeper" in str(config.hydra.sweeper._target_)  # another one chooses its jobs as it goes
        if ranks.first:
            begin_sweep(folder, words, planned if own else None)
        _process.update(sweep=folder, words=words)


def main(argv: Sequence[str] | None = None) -> int:
    """Train and evaluate as the command line asks: `libero train` and train.py.

    Args:
        argv: Hydra's overrides and options, such as `algo=ewc` and `-m`. None: those of this process.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    with ending.debugging(sys.argv[1:] if argv is None else argv) as words:
        try:
            with ending.interruptible(), process_group() as ranks:
                options = read_options(words)
                own = [] if options.config_dir is None else [existing_folder(Path(options.config_dir))]
                folders = [config_folder(), *own]
                check_overrides(options.overrides, folders)
                check_choices(options.overrides, folders)
                try:
                    return _compose_and_run(options, folders, ranks)
                except (HydraException, OmegaConfBaseException) as error:  # it cannot be composed
                    if told := with_suggestion(error, options.overrides, folders):
                        raise told from error
                    raise
        except KeyboardInterrupt as error:
            error.add_note("the same command resumes the run")
            return _report(error)
        except Exception as error:  # noqa: BLE001 - told by kind
            return _report(error)


def _compose_and_run(options: argparse.Namespace, folders: Sequence[Path], ranks: Ranks) -> int:
    """Run the jobs of the command line, several after `-m`; return the worst exit status."""
    sys.argv[1:] = in_order(options, _sweep_folder(options))  # where Hydra reads them
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach the caller, which prints a line
    _process.clear()
    _process.update(ranks=ranks, folders=folders, status=0)
    try:
        hydra.main(version_base="1.3", config_path=str(folders[0]), config_name="config")(_job)()
    except (AssertionError, AttributeError, OSError, TypeError, ValueError) as error:
        if "began" in _process or isinstance(error, LiberoError):
            raise
        # raised by Hydra for overrides that it cannot apply, or a folder of its own that cannot be made
        said = " ".join(str(error).split())
        raise ConfigError(f"the configuration cannot be composed: {said}") from error
    except Exception:
        if "sweep" not in _process:
            raise
        _end_sweep(ranks)  # a launcher lost a job, such as one that its cluster has killed
        raise
    return _end_sweep(ranks) if "sweep" in _process else _process["status"]


def _job(config: DictConfig) -> Path | None:
    """Run one job, in whatever process Hydra's launcher calls it."""
    hydra_config = HydraConfig.get()
    ranks = _process.get("ranks")
    if ranks is None:  # a process of a launcher, which knows the configuration alone
        end_with_parent()
        with ending.interruptible(), process_group() as own:
            _process.update(ranks=own, status=0)
            return _job(config)
    _process["began"] = True
    if hydra_config.mode == RunMode.MULTIRUN:
        config = _named_in_sweep(config, hydra_config)
    learn = partial(experiment.run, config, hydra_config.runtime.choices, ranks)
    if hydra_config.mode != RunMode.MULTIRUN or not ranks.first:
        try:
            return learn()
        except Exception as error:  # noqa: BLE001 - told by kind
            _process["status"] = _report(error)
            if ranks.size > 1:  # the others may be waiting: torchrun ends them when this process ends
                raise SystemExit(_process["status"]) from error
            return None
    file = Path(hydra_config.runtime.output_dir) / JOB_FILE
    key = config_digest(plain_data(config))
    job = JobRecord(int(hydra_config.job.num), key, tuple(hydra_config.overrides.task), "running")
    done = run_job(file, job, learn, _report_line, again=ranks.size > 1)
    if done.exit_status and ranks.size > 1:
        raise SystemExit(done.exit_status)
    return Path(done.run) if done.run else None


def _sweep_folder(options: argparse.Namespace) -> list[str]:
    """Return the override that gives a sweep a folder of its own, by which the same command finds it again."""
    words = options.overrides
    if not options.multirun or any(word.startswith("hydra.sweep.dir=") for word in words):
        return []
    overrides = [word for word in words if "=" in word]
    name = sweep_name(sorted(overrides), list(swept(overrides)))
    return [f"hydra.sweep.dir='${{runs_dir}}/{FOLDER}/{name}'"]


def _named_in_sweep(config: DictConfig, hydra_config: Any) -> DictConfig:
    """Return a job's configuration with a `run_id` that tells its run from those of the sweep's other jobs."""
    words = _process.get("words") or read_sweep(Path(hydra_config.sweep.dir)).words
    several, named = swept(words), {word.partition("=")[0] for word in words}
    own = {key: value for key, _, value in (word.partition("=") for word in hydra_config.overrides.task)}
    name = job_suffix({key: value for key, value in own.items() if key in several or key not in named})
    if not name:
        return config
    config = copy(config)
    config.run_id = name if config.run_id is None else f"{config.run_id}_{name}"
    return config


def _end_sweep(ranks: Ranks) -> int:
    """Say what became of the jobs, compare the runs that are finished, and return the exit status."""
    if not ranks.first:
        return 0
    sweep = read_sweep(_process["sweep"])
    if len(sweep.runs) > 1:
        page = write_report(sweep.runs, sweep.folder / "report.html")
        print(f"{len(sweep.runs)} runs compared: {page}")
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
