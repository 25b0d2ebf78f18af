"""Folders and files of the user. Nothing is created when this module is imported or its functions are called."""

import os
from pathlib import Path
from typing import Any

import yaml

from libero_env.errors import LiberoError


def cache_dir() -> Path:
    """Return `$LIBERO_CACHE`, or by default `libero` in the user's cache folder."""
    if path := os.environ.get("LIBERO_CACHE"):
        return Path(path).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "libero"


def demos_dir() -> Path:
    """Return `$LIBERO_DEMOS`, or by default `demos` in the cache folder."""
    if path := os.environ.get("LIBERO_DEMOS"):
        return Path(path).expanduser()
    return cache_dir() / "demos"


def objects_dir() -> Path:
    """Return the folder of user-defined objects.

    It is `$LIBERO_OBJECTS`, or `objects` of the configuration file, or by default `objects` beside that file.

    Raises:
        LiberoError: As `read_config`.
    """
    path = os.environ.get("LIBERO_OBJECTS") or read_config().get("objects")
    return Path(str(path)).expanduser() if path else config_file().parent / "objects"


def config_file() -> Path:
    """Return `config.yaml` in `$LIBERO_CONFIG_PATH` or by default in `~/.libero`; the file need not exist."""
    folder = os.environ.get("LIBERO_CONFIG_PATH")
    return (Path(folder).expanduser() if folder else Path.home() / ".libero") / "config.yaml"


def read_config() -> dict[str, Any]:
    """Return the content of the configuration file, empty if there is none.

    Raises:
        LiberoError: The file is not valid YAML, or is no mapping.
    """
    path = config_file()
    if not path.is_file():
        return {}
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except yaml.YAMLError as error:
        raise LiberoError(f"{path} is not valid YAML ({error}); fix or remove it") from error
    if not isinstance(found, dict):
        raise LiberoError(f"{path}: expected keys with values such as `assets: PATH`; fix or remove it")
    return found
