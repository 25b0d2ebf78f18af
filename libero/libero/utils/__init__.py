"""The original's helpers, with its second copy of the paths."""

from typing import Any

import libero.libero
from libero.libero import get_libero_path, get_path_dict
from libero.libero import set_libero_default_path as set_libero_path


def __getattr__(name: str) -> Any:
    """Return `libero_config_path` or `config_file`, which depend on `$LIBERO_CONFIG_PATH`."""
    return getattr(libero.libero, name)
