"""From the words of a command line to jobs: words are checked before what learns is imported, which takes seconds."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, open_dict

from libero_env.cli import ending
from libero_env.text import suggest
from lifelong.composition import compose_first, config_folders
from lifelong.errors import RESUME, ConfigError

# of Hydra, by which names and how they are given
OPTIONS: Sequence[tuple[tuple[str, ...], dict[str, Any]]] = (
    (("--multirun", "-m"), {"action": "store_true"}),
    (("--resolve",), {"action": "store_true"}),
    (("--help", "-h"), {"action": "store_true"}),
    (("--hydra-help",), {"action": "store_true"}),
    (("--version",), {"action": "store_true"}),
    (("--config-dir", "-cd"), {}),
    (("--cfg", "-c"), {"choices": ("job", "hydra", "all")}),
    (("--info", "-i"), {"choices": ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")}),
    (("--package", "-p"), {}),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Train and evaluate as the command line asks: `libero train` and train.py.

    Args:
        argv: Hydra's overrides and options, such as `algo=ewc` and `-m`. None: those of this process.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    with ending.general_options(sys.argv[1:] if argv is None else argv) as words:
        try:
            # jobs of a sweep may be done
            note = RESUME if {"-m", "--multirun"} & {*words} else ending.NOT_BEGUN
            with ending.told_if_interrupted(note), ending.interruptible():
                options = read_options(words)
                folders = config_folders(None if options.config_dir is None else Path(options.config_dir))
                config = compose_first(options.overrides, folders)
                if not options.chosen:
                    check_settings(config)
                from lifelong.jobs import launch

                return launch(options, config, folders)
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
            return ending.report(error)


def check_settings(config: DictConfig) -> None:
    """Check the values of settings by which no network is built.

    Raises:
        ConfigError: One is of another kind, or out of range.
    """
    from lifelong.settings import Configuration, plain_data

    own = config.copy()
    with open_dict(own):
        del own["hydra"]
    configuration = Configuration(plain_data(own))
    configuration.settings()
    for group in ("train", "eval", "data"):
        configuration.build(group)


def read_options(words: Sequence[str]) -> argparse.Namespace:
    """Return Hydra's options among the words, which may stand anywhere, as `chosen` too, and `overrides`, the others.

    Raises:
        ConfigError: A word is not an option, or is of sweeps, and this is none.
    """
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    for names, how in OPTIONS:
        parser.add_argument(*names, **how)
    parser.add_argument("overrides", nargs="*")
    try:
        options, unknown = parser.parse_known_intermixed_args(list(words))
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error}") from error
    if unknown:
        valid = [name for (name, *_), _ in OPTIONS]
        raise ConfigError(
            f"{unknown[0]} is not an option.{suggest(unknown[0], valid)} Valid: {', '.join(valid)}; "
            "an override has no dashes, as in algo=ewc"
        )
    given = {name: getattr(options, name[2:].replace("-", "_")) for (name, *_), _ in OPTIONS}
    options.chosen = [name if value is True else f"{name}={value}" for name, value in given.items() if value]
    for word in options.overrides if not options.multirun else ():
        if word.startswith(("hydra/launcher", "hydra/sweeper", "hydra.sweep")):
            raise ConfigError(f"{word.partition('=')[0]} has no effect without -m; leave it out, or set both")
    return options
