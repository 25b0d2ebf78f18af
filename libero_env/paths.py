"""Where files are kept. Nothing is created by importing or asking."""

import os
from pathlib import Path
from typing import Any

import yaml

from libero_env.errors import LiberoError


def cache_dir() -> Path:
    """`$LIBERO_CACHE`, else the platform's cache folder for libero."""
    if path := os.environ.get("LIBERO_CACHE"):
        return Path(path).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "libero"


def demos_dir() -> Path:
    """`$LIBERO_DEMOS`, else `demos` in the cache folder."""
    if path := os.environ.get("LIBERO_DEMOS"):
        return Path(path).expanduser()
    return cache_dir() / "demos"


def objects_dir() -> Path:
    """Where the user's own objects are: `$LIBERO_OBJECTS`, else `objects` of the configuration file, else beside it.

    Raises:
        LiberoError: as `read_config`.
    """
    path = os.environ.get("LIBERO_OBJECTS") or read_config().get("objects")
    return Path(str(path)).expanduser() if path else config_file().parent / "objects"


def config_file() -> Path:
    """`config.yaml` in `$LIBERO_CONFIG_PATH`, else in `~/.libero`; the original's tools write it, it need not exist."""
    folder = os.environ.get("LIBERO_CONFIG_PATH")
    return (Path(folder).expanduser() if folder else Path.home() / ".libero") / "config.yaml"


def read_config() -> dict[str, Any]:
    """The configuration file; empty where there is none.

    Raises:
        LiberoError: it cannot be read as YAML.
    """
    path = config_file()
    if not path.is_file():
        return {}
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except yaml.YAMLError as error:
        raise LiberoError(f"{path} is not valid YAML ({error}); mend or remove it") from error
    if not isinstance(found, dict):
        raise LiberoError(f"{path}: expected keys with values such as `assets: PATH`; mend or remove it")
    return found
