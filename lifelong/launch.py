"""From the command line to a run: composing the configuration, errors in one line, reports of sweeps."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from libero_env.errors import LiberoError, UnknownNameError
from lifelong import experiment
from lifelong.report.page import write_report
from lifelong.training.distributed import Ranks, joined, rank


class CombinedReport(Callback):
    """After `-m`, one report that compares all runs of the sweep."""

    def __init__(self) -> None:
        self._runs: list[Path] = []

    def on_job_end(self, config: DictConfig, job_return: Any, **kwargs: Any) -> None:
        """Note the directory of a run that ended well."""
        if isinstance(job_return._return_value, Path):
            self._runs.append(job_return._return_value)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Compare what ended well; where several processes train together, the first does."""
        if len(self._runs) > 1 and rank() == 0:
            page = write_report(self._runs, Path(config.runs_dir) / "sweep" / "report.html")
            print(f"{len(self._runs)} runs compared: {page}")


def main(config_dir: str) -> int:
    """Run what the command line asks for.

    Args:
        config_dir: Folder of the configuration, absolute or relative to the working directory of the script.

    Returns:
        Exit status: 0, or 1 where something went wrong (told in one line).
    """
    path = Path(sys.argv[0]).resolve().parent / config_dir
    try:
        with joined() as ranks:
            check_choices(sys.argv[1:], path)
            return _compose_and_run(str(path), ranks)
    except LiberoError as error:
        _tell(error)
        return 1
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return 130


def _compose_and_run(path: str, ranks: Ranks) -> int:
    """Exit status of the jobs of the command line, which are several after `-m`."""
    failed = False

    def job(config: DictConfig) -> Path | None:
        nonlocal failed
        try:
            return experiment.run(config, HydraConfig.get().runtime.choices, ranks)
        except (LiberoError, HydraException, OmegaConfBaseException, OSError) as error:
            failed = True
            _tell(error)
            if ranks.size > 1:  # the others may be waiting: torchrun ends them when this process ends
                raise SystemExit(1) from error
            return None

    hydra.main(version_base="1.3", config_path=path, config_name="config")(job)()
    return int(failed)


def _tell(error: Exception) -> None:
    who = f"rank {rank()}: " if rank() else ""
    print(f"error: {who}{_one_line(error)}", file=sys.stderr)


def check_choices(overrides: Sequence[str], config_dir: Path) -> None:
    """Look at the overrides that choose a group's file, before Hydra does.

    Raises:
        UnknownNameError: No such file; the message lists those there are.
    """
    for override in overrides:
        group, _, names = override.partition("=")
        if not (group and names and (config_dir / group).is_dir()):
            continue
        valid = sorted(file.stem for file in (config_dir / group).glob("*.yaml"))
        for name in names.split(","):
            if name not in valid:
                raise UnknownNameError(group, name, valid)


def _one_line(error: Exception) -> str:
    """The message, with the message of what caused it where Hydra wraps one of ours."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, LiberoError):
        cause = cause.__cause__
    return " ".join(str(cause or error).split())
