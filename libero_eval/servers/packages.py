"""Packages that policy servers need, imported when they are first used."""

import importlib
from typing import Any

from libero_env.errors import MissingPackageError

_DISTRIBUTIONS = {"websockets": "websockets", "msgpack": "msgpack", "zmq": "pyzmq"}


def need(module: str) -> Any:
    """Return a module of the extra `servers`, such as `websockets.asyncio.client`.

    Raises:
        MissingPackageError: Its package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = _DISTRIBUTIONS[module.partition(".")[0]]
        raise MissingPackageError(
            f"policy servers need the package {package}, which is not installed",
            "pip install 'libero-lifelong[servers]'",
        ) from error
