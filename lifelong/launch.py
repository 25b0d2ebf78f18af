"""From the command line to a run: the configuration is composed, errors take one line, sweeps get a report."""

import difflib
import math
import os
import re
import sys
from collections.abc import Sequence
from copy import copy
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from libero_env.cli import ending
from libero_env.errors import LiberoError, UnknownNameError, printable
from libero_env.parallel import end_with_parent
from lifelong import experiment
from lifelong.errors import ConfigError, require_package
from lifelong.report.page import write_report
from lifelong.results.saved_config import upgrade_config
from lifelong.settings import plain_data
from lifelong.sweeps import (
    FOLDER,
    JOB_FILE,
    JobRecord,
    begin_sweep,
    config_key,
    job_suffix,
    read_sweep,
    run_job,
    status_lines,
    sweep_name,
)
from lifelong.training.distributed import Ranks, process_group, rank

# launcher -> package of its plug-in, and the extra that installs it
LAUNCHERS = {
    "joblib": ("hydra_plugins.hydra_joblib_launcher", "joblib"),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    "submitit_slurm": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    "ray": ("hydra_plugins.hydra_ray_launcher", "ray"),
}
_process: dict[str, Any] = {}  # of the process that was started: its ranks, and the folder of its sweep


class SweepStart(Callback):
    """Hydra callback that notes what a sweep (`-m`) is asked for, in the process that starts it."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the sweep's file."""
        folder = Path(config.hydra.sweep.dir).resolve()
        words, ranks = list(config.hydra.overrides.task), _process.get("ranks") or Ranks()
        planned = math.prod(len(values) for values in swept(words).values())
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
                folder = config_folder()
                check_choices(words, (folder, *_user_folders(words)))
                return _compose_and_run(words, folder, ranks)
        except (HydraException, OmegaConfBaseException) as error:  # the configuration cannot be composed
            return _report(_with_suggestion(error, words) or error)
        except KeyboardInterrupt as error:
            error.add_note("the same command resumes the run")
            return _report(error)
        except Exception as error:  # noqa: BLE001 - told by kind
            return _report(error)


def compose_run(words: Sequence[str], config_dir: Path | None = None) -> tuple[DictConfig, dict[str, str]]:
    """Compose the configuration of a run, without running it.

    Args:
        words: Overrides, as of `libero train`.
        config_dir: Folder of the user's configuration files beside the package's.

    Returns:
        The configuration, and the name of the file chosen in each group.

    Raises:
        LiberoError: An override names something that does not exist, or cannot be applied.
    """
    folder, own = config_folder(), [] if config_dir is None else [config_dir.resolve()]
    check_choices(words, (folder, *own))
    overrides = [*words, *(f"hydra.searchpath=[file://{path}]" for path in own)]
    try:
        with initialize_config_dir(str(folder), version_base="1.3"):
            config = compose("config", overrides, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise _with_suggestion(error, words) or ConfigError(
            f"the configuration cannot be composed: {' '.join(str(error).split())}"
        ) from error
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    return config, choices


def swept(words: Sequence[str]) -> dict[str, list[str]]:
    """Return the overrides that list several values, as key -> values, such as algo.strength=0.1,1.

    An interval, from which another sweeper than Hydra's own chooses, has no values.

    Raises:
        ConfigError: A word is no override.
    """
    try:
        overrides = OverridesParser.create().parse_overrides(list(words))
    except HydraException as error:
        raise ConfigError(f"{' '.join(str(error).split())}") from error
    return {
        override.get_key_element(): list(override.sweep_string_iterator())
        if override.is_discrete_sweep()
        else []
        for override in overrides
        if override.is_sweep_override()
    }


def config_folder() -> Path:
    """Return the folder of config.yaml: in an installed package lifelong/configs, in a checkout configs."""
    package = Path(str(resources.files("lifelong")))
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / "config.yaml").is_file():
            return folder
    raise LiberoError(
        f"no configuration files: {package / 'configs'} and {package.parent / 'configs'} do not exist; "
        "install libero-lifelong again"
    )


def check_choices(overrides: Sequence[str], folders: Sequence[Path]) -> None:
    """Check the overrides that choose a group's file, before Hydra does.

    Args:
        overrides: The words of the command line.
        folders: Folders of configuration files, in which a group is a subfolder.

    Raises:
        UnknownNameError: A group has no such file; the message lists its files.
    """
    for override in overrides:
        group, _, names = override.partition("=")
        if group == "hydra/launcher":
            _check_launcher(names)
            continue
        found = [folder / group for folder in folders if group and names and (folder / group).is_dir()]
        valid = sorted({file.stem for folder in found for file in folder.glob("*.yaml")})
        for name in names.split(",") if found else ():
            if name not in valid:
                raise UnknownNameError(group, name, valid)


def _check_launcher(name: str) -> None:
    """Check that the package of a launcher is installed.

    Raises:
        MissingPackageError: It is not; the message says what to install.
    """
    for launcher, (package, extra) in LAUNCHERS.items():
        if name == launcher or launcher in _launcher_defaults(name):
            require_package(package, extra)


def _launcher_defaults(name: str) -> list[str]:
    """Return the launchers that a file of the package's configuration builds on."""
    file = config_folder() / "hydra" / "launcher" / f"{name}.yaml"
    plain: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
    return plain.get("defaults", [])


def _user_folders(words: Sequence[str]) -> list[Path]:
    """Return the folders that `--config-dir` (`-cd`) adds to Hydra's search path."""
    folders = []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word in ("--config-dir", "-cd"):
            folders.append(Path(following))
        elif word.startswith("--config-dir="):
            folders.append(Path(word.partition("=")[2]))
    return folders


def _compose_and_run(words: list[str], folder: Path, ranks: Ranks) -> int:
    """Run the jobs of the command line, several after `-m`; return the worst exit status."""
    sys.argv[1:] = [*words, *_sweep_folder(words)]  # where Hydra reads them
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach the caller, which prints a line
    _process.clear()
    _process.update(ranks=ranks, status=0)
    try:
        hydra.main(version_base="1.3", config_path=str(folder), config_name="config")(_job)()
    except (AssertionError, AttributeError, OSError, TypeError, ValueError) as error:
        if "began" in _process or isinstance(error, LiberoError):
            raise
        # raised by Hydra for overrides that it cannot apply, or a folder of its own that cannot be made
        raise ConfigError(f"the configuration cannot be composed: {error}") from error
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
    key = config_key(plain_data(config))
    job = JobRecord(int(hydra_config.job.num), key, tuple(hydra_config.overrides.task), "running")
    done = run_job(file, job, learn, _report_line, again=ranks.size > 1)
    if done.exit_status and ranks.size > 1:
        raise SystemExit(done.exit_status)
    return Path(done.run) if done.run else None


def _sweep_folder(words: Sequence[str]) -> list[str]:
    """Return the override that gives a sweep a folder of its own, by which the same command finds it again."""
    several = {"-m", "--multirun"} & set(words)
    if not several or any(word.startswith("hydra.sweep.dir=") for word in words):
        return []
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
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


def _with_suggestion(error: Exception, words: Sequence[str]) -> LiberoError | None:
    """Return an error that names the keys there are, if an override names one that there is not."""
    found = re.search(r"Could not override '([\w.]+)'", str(error))
    if found is None:
        return None
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        node: Any = compose("config", [w for w in words if re.match(r"\w+=\w+$", w) and _is_choice(w)])
    plain: Any = OmegaConf.to_container(node)
    valid = sorted(key for key in _dotted(plain) if not key.rpartition(".")[2].startswith("_"))
    top, _, rest = found[1].partition(".")
    if rest and top in plain:
        within = [key for key in valid if key.startswith(f"{top}.")]
    else:
        within = sorted({key.partition(".")[0] for key in valid})
    wanted = found[1] if rest and top in plain else top
    near = [*_renamed(plain, wanted), *difflib.get_close_matches(wanted, within, n=1)]
    hint = f" Did you mean {near[0]}?" if near else ""
    return ConfigError(
        f"unknown key {wanted} of the configuration.{hint} Valid: {', '.join(within) or 'none'}; "
        f"+{found[1]}=... adds a key that the chosen files lack"
    )


def _dotted(node: Any, prefix: str = "") -> list[str]:
    """Return the dotted keys of all values of a configuration."""
    if not isinstance(node, dict) or not node:
        return [prefix]
    return [
        name
        for key, part in node.items()
        for name in _dotted(part, f"{prefix}.{key}" if prefix else str(key))
    ]


def _renamed(config: dict[str, Any], name: str) -> list[str]:
    """Return the key of today for a key of earlier versions, such as `policy.head_hidden`."""
    group, _, key = name.partition(".")
    if group not in ("policy", "algo"):
        return []
    target, marked = {"_target_": config[group].get("_target_")}, "\0"  # a value that can be found again
    upgraded = upgrade_config({group: {**target, key: marked}})
    return [found for found in _dotted(upgraded) if found != name and _value(upgraded, found) == marked]


def _value(config: Any, name: str) -> Any:
    for key in name.split("."):
        config = config[key]
    return config


def _is_choice(word: str) -> bool:
    """Return whether an override chooses a file of the package's configuration."""
    group, _, name = word.partition("=")
    return (config_folder() / group / f"{name}.yaml").is_file()


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
