"""Folders of task files, initial states, demonstrations and assets, as the original configures them.

The configuration file is read if it exists, and only `set_libero_default_path` writes it. Without it, task files and
initial states are those of this package, which `get_libero_path` writes to the cache folder.
"""

import logging
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from libero_env.errors import UnknownNameError, require_known
from libero_env.paths import config_file as _config_file
from libero_env.paths import read_config

if TYPE_CHECKING:
    libero_config_path: str
    config_file: str

__all__ = [
    "config_file",
    "get_assets_path",
    "get_default_path_dict",
    "get_libero_path",
    "libero_config_path",
    "set_libero_default_path",
]

_log = logging.getLogger(__name__)
_noted: set[str] = set()
_HERE = Path(__file__).parent
_KEYS = ("benchmark_root", "bddl_files", "init_states", "datasets", "assets")


def __getattr__(name: str) -> str:
    """Return `libero_config_path` or `config_file`, which depend on `$LIBERO_CONFIG_PATH`."""
    if name in ("libero_config_path", "config_file"):
        return str(_config_file().parent if name == "libero_config_path" else _config_file())
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def get_default_path_dict(custom_location: str | os.PathLike | None = None) -> dict[str, str]:
    """Return key -> path: in a folder laid out like the original package, or by default in the cache folder."""
    from libero._adapters.files import generated_paths

    if custom_location is None:
        return {"benchmark_root": str(_HERE), **generated_paths()}
    root = Path(custom_location)
    folders = ("", "bddl_files", "init_files", "../datasets", "assets")
    return {key: os.path.normpath(root / folder) for key, folder in zip(_KEYS, folders, strict=True)}


def get_path_dict() -> dict[str, str]:
    """Return key -> path as configured, with defaults for missing keys."""
    default, configured = get_default_path_dict(), {k: v for k, v in read_config().items() if k in _KEYS}
    return {**default, **{k: v for k, v in configured.items() if not is_left_over(k, v)}}


def is_left_over(key: str, path: str) -> bool:
    """Return whether a configured folder is one of the original's package or checkout that is not there (any more).

    Its config.yaml names `libero/libero/bddl_files` and so on; those of this package are generated.
    """
    names = {"bddl_files": "bddl_files", "init_states": "init_files", "assets": "assets"}
    folder = Path(path).expanduser()
    is_empty = not folder.is_dir() or not any(folder.iterdir())
    return is_empty and folder.parts[-2:] == ("libero", names.get(key, ""))


def get_libero_path(query_key: str) -> str:
    """Return one of the paths, and warn if it does not exist; raise an UnknownNameError if the key does not exist."""
    from libero._adapters.files import allow_arrays, ensure

    require_known("path", query_key, _KEYS)
    allow_arrays()
    path, configured = get_path_dict()[query_key], read_config().get(query_key)
    if configured and configured != path and query_key not in _noted:
        _noted.add(query_key)
        _log.warning("%s: %s has no files; those of this package are used, %s", query_key, configured, path)
    ensure(query_key, path)
    if not os.path.exists(path):
        where = f"as {_config_file()} configures" if query_key in read_config() else "the default"
        warnings.warn(f"{query_key}: {path}, {where}, does not exist", stacklevel=2)
    return path


def get_assets_path() -> str:
    """Return the folder of the models, `get_libero_path("assets")`."""
    return get_libero_path("assets")


def set_libero_default_path(custom_location: str | os.PathLike | None = None) -> None:
    """Write the paths of `get_default_path_dict` into the configuration file; without a location, take paths out."""
    from libero_env.storage import atomic_write_text

    kept = {key: value for key, value in read_config().items() if key not in _KEYS}
    paths = {} if custom_location is None else get_default_path_dict(custom_location)
    atomic_write_text(_config_file(), yaml.safe_dump(kept | paths), fsync=True)
