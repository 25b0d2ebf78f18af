"""Where files are kept. Nothing is created by importing or asking."""

import os
from pathlib import Path


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
