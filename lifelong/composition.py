"""From the words of a command line to a configuration; mistakes are told with what to write instead."""

import argparse
import re
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.text import closest
from lifelong.errors import ConfigError, require_package

# launcher -> package of its plug-in, and the extra that installs it
LAUNCHERS = {
    "joblib": ("hydra_plugins.hydra_joblib_launcher", "joblib"),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    "submitit_slurm": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    "ray": ("hydra_plugins.hydra_ray_launcher", "ray"),
}
# keys at the top of the original's configuration -> those of today
ORIGINAL_KEYS = {
    "lifelong": "algo",
    "benchmark_name": "benchmark",
    "task_embedding_format": "language",
    "use_wandb": "wandb",
    "pretrain_model_path": "init_from",
}
OPTIONS = "-m, --config-dir DIR, --cfg job, --info searchpath"  # of Hydra's, those that the help shows
_UNKNOWN = re.compile(r"Could not override '([^']+)'")  # as Hydra says


def compose_run(words: Sequence[str], config_dir: Path | None = None) -> tuple[DictConfig, dict[str, str]]:
    """Compose the configuration of a run, without running it.

    Args:
        words: Overrides, as of `libero train`.
        config_dir: Folder of the user's configuration files beside the package's.

    Returns:
        The configuration, and the name of the file chosen in each group.

    Raises:
        LiberoError: An override or the folder names something that does not exist, or an override cannot be applied.
    """
    folders = [config_folder(), *([] if config_dir is None else [existing_folder(config_dir)])]
    check_overrides(words, folders)
    check_choices(words, folders)
    try:
        return _composed(words, folders)
    except (HydraException, OmegaConfBaseException) as error:
        raise with_suggestion(error, words, folders) or ConfigError(
            f"the configuration cannot be composed: {' '.join(str(error).split())}"
        ) from error


def _composed(words: Sequence[str], folders: Sequence[Path]) -> tuple[DictConfig, dict[str, str]]:
    """Compose the configuration from the package's folder and those after it; see `compose_run`."""
    own = [f"hydra.searchpath=[file://{path.resolve()}]" for path in folders[1:]]
    with initialize_config_dir(str(folders[0]), version_base="1.3"):
        config = compose("config", [*words, *own], return_hydra_config=True)
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    return config, choices


def swept(words: Sequence[str], folders: Sequence[Path] = ()) -> dict[str, list[str]]:
    """Return the overrides that list several values, as key -> values, such as algo.strength=0.1,1.

    An interval, from which another sweeper than Hydra's own chooses, has no values.

    Args:
        words: Overrides.
        folders: Folders of configuration files, whose names glob() matches, beside the package's.

    Raises:
        ConfigError: A word is no override.
    """
    try:
        overrides = OverridesParser.create().parse_overrides(list(words))
    except HydraException as error:
        raise ConfigError(f"{' '.join(str(error).split())}") from error
    known = [config_folder(), *folders]
    return {o.get_key_element(): _listed(o, known) for o in overrides if o.is_sweep_override()}


def _listed(override: Override, folders: Sequence[Path]) -> list[str]:
    """Return the values that an override of a sweep lists; see `swept`."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(_names(override.get_key_element(), folders))
    return list(override.sweep_string_iterator()) if override.is_discrete_sweep() else []


def _names(group: str, folders: Sequence[Path]) -> list[str]:
    """Return the names of a group's files; none if there is no such group."""
    return sorted({file.stem for folder in folders for file in (folder / group).glob("*.yaml")})


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


def read_options(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of Hydra among the words, which may stand anywhere, and `overrides`, the other words.

    Raises:
        ConfigError: A word is no option; the message says what to write instead.
    """
    parser = get_args_parser()
    parser.exit_on_error = False
    try:
        options, unknown = parser.parse_known_intermixed_args(list(words))
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error}; write options as in {OPTIONS}") from error
    if options.multirun and (options.cfg or options.info):
        which = "--cfg" if options.cfg else "--info"
        raise ConfigError(
            f"-m and {which} exclude each other: {which} is about one job; leave out -m, and name one value"
        )
    if unknown:
        raise _no_option(next((one for one in unknown if one.startswith("-")), unknown[0]), words, options)
    return options


def in_order(options: argparse.Namespace, added: Sequence[str]) -> list[str]:
    """Return a command line whose overrides, and those added, stand at its end: argparse takes none after an option."""
    given = {_option(name): value for name, value in vars(options).items()}
    flags = [option for option, value in given.items() if value is True]
    valued = [f"{option}={value}" for option, value in given.items() if isinstance(value, str)]
    return [*flags, *valued, *options.overrides, *added]


def _no_option(word: str, words: Sequence[str], options: argparse.Namespace) -> ConfigError:
    """Return the error for a word that is no option, such as `--algo` before `ewc`."""
    option, _, value = word.partition("=")
    key = option.lstrip("-").replace("-", "_")
    if key.partition(".")[0] in (*config_groups(), *config_settings()):
        after = [*words, ""][words.index(word) + 1]
        value = value or ("VALUE" if "=" in after or after.startswith("-") else after or "VALUE")
        return ConfigError(f"{option} is no option: an override has no dashes, write {key}={value}")
    near = closest(option, map(_option, vars(options)))
    hint = f" Did you mean {near}?" if near else ""
    return ConfigError(
        f"unknown option {option}.{hint} Valid: {OPTIONS}; an override has no dashes, as in algo=ewc"
    )


def _option(name: str) -> str:
    """Return the option whose value Hydra's parser stores under a name."""
    return f"--{name.replace('_', '-')}"


def config_groups() -> dict[str, str]:
    """Return group -> name of its default file, such as algo -> sequential."""
    pairs = [pair for one in _config_file()["defaults"] if isinstance(one, dict) for pair in one.items()]
    return {group: name for group, name in pairs if " " not in group}  # without `optional` and `override`


def config_settings() -> list[str]:
    """Return the keys at the top of the configuration that are no groups, such as seed."""
    return [key for key in _config_file() if key not in ("defaults", "hydra")]


def _config_file() -> dict[str, Any]:
    return _read_yaml(config_folder() / "config.yaml")


def _read_yaml(file: Path) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
    return plain if isinstance(plain, dict) else {}


def existing_folder(folder: Path) -> Path:
    """Return the folder of `--config-dir`.

    Raises:
        ConfigError: There is no such folder.
    """
    if folder.is_dir():
        return folder
    if folder.exists():
        raise ConfigError(
            f"--config-dir: {folder} is a file; give a folder with files such as algo/NAME.yaml"
        )
    beside = [one.name for one in folder.parent.iterdir() if one.is_dir()] if folder.parent.is_dir() else []
    near = closest(folder.name, beside)
    hint = f" Did you mean {folder.parent / near}?" if near else ""
    raise ConfigError(
        f"--config-dir: the folder {folder} does not exist.{hint} Give one that has files such as algo/NAME.yaml"
    )


def check_overrides(words: Sequence[str], folders: Sequence[Path]) -> None:
    """Check that each word is an override, before Hydra does.

    Args:
        words: The words of the command line that are no options.
        folders: Folders of configuration files, in which a group is a subfolder.

    Raises:
        ConfigError: A word is not KEY=VALUE or ~KEY; the message says what to write instead.
    """
    for i, word in enumerate(words):
        if word.startswith(",") or word.endswith(","):
            joined = "".join(words[max(0, i - word.startswith(",")) : i + 1 + word.endswith(",")])
            raise ConfigError(f"{word} is a part of a list: values are listed without spaces; write {joined}")
        if word.startswith("-") or not ("=" in word or word.startswith("~")):
            raise ConfigError(f"{word} is no override: {_as_override(word, folders)}")


def _as_override(word: str, folders: Sequence[Path]) -> str:
    """Return what to write instead of a word without `=`."""
    groups = config_groups()
    having = [group for group in groups if _is_choice(group, word, folders)]
    if having:
        return f"write {' or '.join(f'{group}={word}' for group in having)}"
    if word.lstrip("+").partition(".")[0] in (*groups, *config_settings()):
        return f"write {word}=VALUE"
    return "an override is KEY=VALUE, such as algo=ewc or seed=2"


def check_choices(overrides: Sequence[str], folders: Sequence[Path]) -> None:
    """Check the overrides that choose a group's file, before Hydra does.

    Args:
        overrides: The words of the command line.
        folders: Folders of configuration files, in which a group is a subfolder.

    Raises:
        UnknownNameError: A group has no such file; the message lists its files.
    """
    for override in overrides:
        group, _, text = override.partition("=")
        if group == "hydra/launcher":
            _check_launcher(text)
        elif group and text and any((folder / group).is_dir() for folder in folders):
            valid = _names(group, folders)
            for name in _chosen(group, [override], folders):
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
    return _read_yaml(config_folder() / "hydra" / "launcher" / f"{name}.yaml").get("defaults", [])


def with_suggestion(error: Exception, words: Sequence[str], folders: Sequence[Path]) -> LiberoError | None:
    """Return an error that names the keys or groups there are, if an override names one that there is not."""
    found = _UNKNOWN.search(str(error))
    if found is None:
        return None
    GlobalHydra.instance().clear()
    name, groups, settings = found[1], config_groups(), config_settings()
    top, _, rest = name.partition(".")
    if "/" in name:
        return _without_group(name, words, folders)
    if top in groups:
        return _without_key(name, words, folders)
    if top in settings:
        return ConfigError(f"unknown key {name} of the configuration: {top} has no keys; write {top}=VALUE")
    near = ORIGINAL_KEYS.get(top) or closest(top, [*groups, *settings])
    hint = f" Did you mean {near}?" if near else ""
    return ConfigError(
        f"unknown key {top} of the configuration.{hint} Valid: the groups {', '.join(groups)}; the settings "
        f"{', '.join(settings)}"
    )


def _without_group(name: str, words: Sequence[str], folders: Sequence[Path]) -> LiberoError:
    """Return the error for a group inside another one, such as `algo/estimator`, that the chosen file lacks."""
    group, _, inner = name.rpartition("/")
    if not any((folder / name).is_dir() for folder in folders):
        nested = {str(d.relative_to(f)) for f in folders for g in config_groups() for d in (f / g).glob("*/")}
        return UnknownNameError("group", name, {*config_groups(), *nested})
    defaults = {file: plain.get("defaults", []) for file, plain in _files(group, folders)}
    having = [file for file, lines in defaults.items() if any(inner in line for line in lines)]
    chosen = _chosen(group, words, folders) or [config_groups().get(group, "...")]
    lacking = next((file for file in chosen if file not in having), chosen[0])
    return ConfigError(
        f"{group}={lacking} has no group {inner}; leave out {name}, or choose a file that has one: "
        f"{', '.join(f'{group}={file}' for file in having)}"
    )


def _without_key(name: str, words: Sequence[str], folders: Sequence[Path]) -> LiberoError | None:
    """Return the error for a key that the chosen file of its group lacks; None where nothing can be composed."""
    group = name.partition(".")[0]
    for file in _chosen(group, words, folders) or [""]:  # of a sweep, the first one that lacks it
        try:
            config, files = _composed(_choices(words, folders, {group: file}), folders)
        except (HydraException, OmegaConfBaseException):
            return None
        plain: Any = OmegaConf.to_container(config)
        valid = [k for k in _dotted(plain.get(group), group) if not k.rpartition(".")[2].startswith("_")]
        if name not in valid:
            break
    if valid in ([], [group]):
        return _without_keys(name, files[group], words, folders)
    near = closest(name, valid)
    hint = f" Did you mean {near}?" if near else ""
    return ConfigError(
        f"unknown key {name} of the configuration.{hint} Valid: {', '.join(sorted(valid))}; "
        f"+{name}=... adds a key that the chosen files lack"
    )


def _without_keys(name: str, file: str, words: Sequence[str], folders: Sequence[Path]) -> LiberoError:
    """Return the error for a key of a file that has none, such as that of the default algorithm."""
    group, _, key = name.partition(".")
    default = "" if _chosen(group, words, folders) else ", the default,"
    keys = {other: _dotted(plain) for other, plain in _files(group, folders)}
    near = closest(key, {one for found in keys.values() for one in found})
    having = sorted(other for other, found in keys.items() if near in found)
    advice = (
        f"{group}.{near} is a key of {', '.join(having)}: choose one with {group}=NAME"
        if having
        else f"choose another with {group}=NAME; valid names: {', '.join(sorted(keys))}"
    )
    return ConfigError(
        f"unknown key {name} of the configuration: {group}={file}{default} has no keys; {advice}"
    )


def _chosen(group: str, words: Sequence[str], folders: Sequence[Path]) -> list[str]:
    """Return the files that the words choose of a group: several in a sweep, none where its default stands."""
    chosen = [word for word in words if word.startswith(f"{group}=")][-1:]
    return swept(chosen, folders).get(group) or [word.partition("=")[2] for word in chosen]


def _choices(words: Sequence[str], folders: Sequence[Path], own: dict[str, str]) -> list[str]:
    """Return the words that choose files, of a sweep the first ones, but for the groups whose files are given."""
    groups = [word.partition("=")[0] for word in words]
    groups = [group for group in groups if group and any((folder / group).is_dir() for folder in folders)]
    found = {group: _chosen(group, words, folders)[0] for group in groups} | own
    return [f"{group}={name}" for group, name in found.items() if name]


def _files(group: str, folders: Sequence[Path]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the files of a group: name, and what is in it."""
    for file in sorted(file for folder in folders for file in (folder / group).glob("*.yaml")):
        yield file.stem, _read_yaml(file)


def _dotted(node: Any, prefix: str = "") -> list[str]:
    """Return the dotted keys of all values of a configuration."""
    if not isinstance(node, dict) or not node:
        return [prefix]
    return [
        name
        for key, part in node.items()
        for name in _dotted(part, f"{prefix}.{key}" if prefix else str(key))
    ]


def _is_choice(group: str, name: str, folders: Sequence[Path]) -> bool:
    """Return whether a group has a file of this name."""
    return bool(group) and any((folder / group / f"{name}.yaml").is_file() for folder in folders)
