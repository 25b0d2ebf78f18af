"""The original's helpers, with its second copy of the paths."""

import logging
import sys
import time
from pathlib import Path
from typing import Any

import libero.libero
from libero._adapters.lookup import alias_modules
from libero.libero import get_libero_path, get_path_dict
from libero.libero import set_libero_default_path as set_libero_path


def __getattr__(name: str) -> Any:
    """Return `libero_config_path` or `config_file`, which depend on `$LIBERO_CONFIG_PATH`."""
    return getattr(libero.libero, name)


def get_logger(
    name: str = "libero", path: str | Path | None = None, level: int = logging.INFO
) -> logging.Logger:
    """Return the logger of this name; handlers are added once."""
    logger = logging.getLogger(name)
    if not logger.handlers:
        handlers: list[logging.Handler] = [logging.StreamHandler(sys.stdout)]
        if path is not None:
            handlers.append(logging.FileHandler(path))
        for handler in handlers:
            handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
            logger.addHandler(handler)
        logger.setLevel(level)
    return logger


get_project_logger = get_logger


class Timer:
    """Measures the duration of its block."""

    value: float | None = None

    def __enter__(self) -> "Timer":
        self.start = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        self.value = time.perf_counter() - self.start

    def get_elapsed_time(self) -> float | None:
        """Return the duration of the block in seconds; None before its end."""
        return self.value


alias_modules(__name__, "log_utils time_utils")
