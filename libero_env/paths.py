"""Folders and files of the user. Nothing is created when this module is imported or its functions are called."""

import os
from pathlib import Path

from libero_env.errors import LiberoError
from libero_env.storage import read_yaml_file
from libero_env.validation import validate

_KEYS = (
    *("benchmark_root", "bddl_files", "init_states", "datasets", "assets", "objects", "robot"),
    *("libero_plus", "libero_pro"),
)


def cache_dir() -> Path:
    """Return `$LIBERO_CACHE`, or by default `libero` in the user's cache folder; an absolute path.

    Raises:
        LiberoError: The user has no home folder.
    """
    if path := os.environ.get("LIBERO_CACHE"):
        return _absolute(path, "LIBERO_CACHE")
    found = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(found) if os.path.isabs(found) else _absolute("~/.cache", "LIBERO_CACHE")) / "libero"


def demos_dir() -> Path:
    """Return `$LIBERO_DEMOS`, or by default `demos` in the cache folder; an absolute path.

    Raises:
        LiberoError: As `cache_dir`.
    """
    if path := os.environ.get("LIBERO_DEMOS"):
        return _absolute(path, "LIBERO_DEMOS")
    return cache_dir() / "demos"


def objects_dir() -> Path:
    """Return the folder of user-defined objects.

    It is `$LIBERO_OBJECTS`, or `objects` of the configuration file, or by default `objects` beside that file.

    Raises:
        LiberoError: As `read_config`.
    """
    path = os.environ.get("LIBERO_OBJECTS") or read_config().get("objects")
    return _absolute(str(path), "LIBERO_OBJECTS") if path else config_file().parent / "objects"


def config_file() -> Path:
    """Return `config.yaml` in `$LIBERO_CONFIG_PATH` or by default in `~/.libero`; the file need not exist.

    Raises:
        LiberoError: The user has no home folder.
    """
    folder = os.environ.get("LIBERO_CONFIG_PATH") or "~/.libero"
    return _absolute(folder, "LIBERO_CONFIG_PATH") / "config.yaml"


def read_config() -> dict[str, str]:
    """Return the paths in the configuration file, empty if there is none; keys without a value are left out.

    Keys that this package does not use may have any value.

    Raises:
        LiberoError: The file is not valid YAML, has no keys, or a value that is not a text.
    """
    path = config_file()
    if not path.is_file():
        return {}
    found = read_yaml_file(path)
    data = {} if found.data is None else found.data
    if isinstance(data, dict):
        data = {key: value for key, value in data.items() if key in _KEYS}
    paths = validate(dict[str, str | None], data, source=found.source, line_of=found.line_of)
    return {key: value for key, value in paths.items() if value}


def _absolute(path: str, variable: str) -> Path:
    """Return a path with the home folder in place of `~`, relative to the working directory."""
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError as error:
        raise LiberoError(f"{path}: {error}; set {variable} to a folder") from None
