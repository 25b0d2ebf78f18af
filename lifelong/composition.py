"""From the words of a command line to a configuration; for a key or file that does not exist, the nearest is named."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from libero_env.errors import LiberoError, UnknownNameError, require_known, require_package
from libero_env.text import flatten, suggest
from lifelong.errors import ConfigError
from lifelong.settings.obeyed import require_obeyed

# launcher -> package of its plug-in
LAUNCHERS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
    "ray": "hydra_plugins.hydra_ray_launcher",
}
# errors by which Hydra says that an override cannot be applied
REFUSALS = (
    *(HydraException, OmegaConfBaseException),
    *(AssertionError, AttributeError, OSError, TypeError, ValueError),
)


def compose_run(words: Sequence[str], config_dir: Path | None = None) -> tuple[DictConfig, dict[str, str]]:
    """Compose the configuration of a run, without running it.

    Args:
        words: Overrides, as of `libero train`; of those that list several values, as for a sweep, the first counts.
        config_dir: Folder of the user's configuration files beside the package's.

    Returns:
        The configuration, and the name of the file chosen in each group.

    Raises:
        LiberoError: An override or the folder names something that does not exist, or an override cannot be applied.
    """
    config = compose_first(words, config_folders(config_dir))
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    return config, choices


def compose_first(words: Sequence[str], folders: Sequence[Path]) -> DictConfig:
    """Compose the configuration of a command, of a sweep that of its first job, with Hydra's own in `hydra`.

    Args:
        words: Overrides.
        folders: Folders of configuration files, from `config_folders`.

    Raises:
        LiberoError: An override names something that does not exist, or cannot be applied.
    """
    for group, names in swept(words, folders).items():
        for name in names if any((folder / group).is_dir() for folder in folders) else ():
            require_known(group, name, _names(group, folders))
    first = _first(words, folders)
    try:
        config = _compose(first, folders)
    except REFUSALS as error:
        raise explained(error, words, folders) from error
    check_obeyed(config, config.hydra.runtime.choices, first, folders, swept(words, folders))
    return config


def check_obeyed(
    config: DictConfig,
    choices: Mapping[str, str],
    words: Sequence[str],
    folders: Sequence[Path],
    varied: Collection[str] = (),
) -> None:
    """Check that what the words of a single run choose is not replaced or unused.

    Args:
        config: Configuration that they compose, with its interpolations.
        choices: Name of the file chosen in each group.
        words: Overrides.
        folders: Folders of configuration files, from `config_folders`.
        varied: Keys that other jobs of the sweep have with other values, some of which may read what this one does not.

    Raises:
        ConfigError: `compat` replaces a file within a group, as of algo/estimator=sample, or no one reads a key.
    """
    pairs = [word.lstrip("+~").partition("=") for word in words]
    require_obeyed(config, [key for key, _, value in pairs if value != "null"], varied)
    for key, _, name in pairs:
        if key == "benchmark.horizon" and not OmegaConf.is_interpolation(config.eval, "horizon"):
            raise ConfigError(
                f"{key} has no effect with preset={choices['preset']}, where eval.horizon is {config.eval.horizon}; "
                "set eval.horizon"
            )
        files = [folder / key / f"{name}.yaml" for folder in folders if "/" in key]
        for file in filter(Path.is_file, files if choices["compat"] != "none" else ()):
            asked = OmegaConf.select(OmegaConf.load(file), "_target_")
            found = OmegaConf.select(config, f"{key.replace('/', '.')}._target_")
            if asked not in (None, found):
                raise ConfigError(
                    f"{key} has no effect with compat={choices['compat']}, which has {found} there; leave one of them "
                    "out"
                )


def _first(words: Sequence[str], folders: Sequence[Path]) -> list[str]:
    """Return the overrides of a sweep's first job."""
    lists = swept(words, folders)
    single = [word for word in words if word.partition("=")[0] not in lists]
    return [*single, *(f"{key}={values[0]}" for key, values in lists.items() if values)]


def _compose(words: Sequence[str], folders: Sequence[Path]) -> DictConfig:
    paths = ",".join(f"file://{path.resolve()}" for path in folders[1:])
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(folders[0]), version_base="1.3"):
        return compose("config", [*words, f"hydra.searchpath=[{paths}]"], return_hydra_config=True)


def explained(error: Exception, words: Sequence[str], folders: Sequence[Path]) -> LiberoError:
    """Return an error of Hydra's in one line, with the nearest name where a file or key does not exist.

    Args:
        words: Overrides.
    """
    group, _, name = str(getattr(error, "missing_cfg_file", None) or "").rpartition("/")
    if group == "hydra/launcher" and name in LAUNCHERS:
        require_package(LAUNCHERS[name])
    if group:
        return UnknownNameError(group, name, _names(group, folders))
    if key := getattr(error.__cause__, "full_key", None):
        typed = next((one for word in words if (one := word.partition("=")[0]).startswith(key)), key)
        with suppress(*REFUSALS):
            for chosen in _choices(words, folders):
                config: Any = OmegaConf.to_container(_compose(chosen, folders))
                del config["hydra"]
                if (known := flatten(config)).keys() & {typed}:
                    continue
                beside = [one for one in known if one.startswith(f"{typed.partition('.')[0]}.")]
                valid = [one for one in beside or config if not one.rpartition(".")[2].startswith("_")]
                error = UnknownNameError("key of the configuration", typed, valid, unlisted=[*config, *known])
                inner = [one for one in known if one.endswith(f".{typed}")]
                return ConfigError(f"{error}; there is {' and '.join(inner)}") if inner else error
    return ConfigError(f"the configuration cannot be composed: {' '.join(str(error).split())}")


def _choices(words: Sequence[str], folders: Sequence[Path]) -> Iterator[tuple[str, ...]]:
    """Yield the words by which each job of a command chooses files of groups."""
    lists = swept(words, folders)
    keys = [word.partition("=")[0] for word in words]
    groups = {
        key: word for key, word in zip(keys, words, strict=True) if any((f / key).is_dir() for f in folders)
    }
    named = (
        [f"{key}={value}" for value in lists[key]] if key in lists else [word] for key, word in groups.items()
    )
    return itertools.product(*named)


def swept(words: Sequence[str], folders: Sequence[Path] = ()) -> dict[str, list[str]]:
    """Return the overrides that list several values, as key -> values, such as algo.strength=0.1,1.

    An interval, from which another sweeper than Hydra's own chooses, has no values.

    Args:
        words: Overrides.
        folders: Folders of configuration files, whose names glob() matches; none for the package's.

    Raises:
        ConfigError: A word is not an override, or one of several values for a key stands beside another word for it.
    """
    try:
        overrides = OverridesParser.create().parse_overrides(list(words))
    except (HydraException, ValueError) as error:  # of thousands of digits
        raise ConfigError(
            f"{' '.join(str(error).split())} (an override is KEY=VALUE, such as algo=ewc or seed=1,2)"
        ) from error
    folders = folders or [config_folder()]
    given = [o.get_key_element() for o in overrides]
    for key in (o.get_key_element() for o in overrides if o.is_sweep_override()):
        if given.count(key) > 1:
            several = " and ".join(word for word in words if word.partition("=")[0] == key)
            raise ConfigError(f"{several}: {key} is given twice; leave one of them out")
    return {o.get_key_element(): _values(o, folders) for o in overrides if o.is_sweep_override()}


def _values(override: Override, folders: Sequence[Path]) -> list[str]:
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


def config_folders(config_dir: Path | None = None) -> list[Path]:
    """Return the folder of the package's configuration files, and that of `--config-dir`.

    Raises:
        ConfigError: The latter is not a folder, or has a file of the package's, which goes first.
    """
    if config_dir is None:
        return [config_folder()]
    if not config_dir.is_dir():
        beside = [one.name for one in config_dir.parent.iterdir()] if config_dir.parent.is_dir() else []
        hint = suggest(config_dir.name, [name for name in beside if (config_dir.parent / name).is_dir()])
        raise ConfigError(
            f"--config-dir: {config_dir} is not a folder.{hint} Give one that has files such as algo/NAME.yaml"
        )
    package = config_folder()
    if package.resolve() != config_dir.resolve():
        for path in package.rglob("*.yaml"):
            if (own := config_dir / path.relative_to(package)).is_file():
                raise ConfigError(
                    f"--config-dir: {own} would not be read: the package has a file of this name; give it another, "
                    f"such as {path.stem}_own.yaml"
                )
    return [package, config_dir]
