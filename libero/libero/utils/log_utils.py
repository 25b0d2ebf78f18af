"""A logger that writes to the console, and to a file."""

import logging
import sys
from pathlib import Path


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
