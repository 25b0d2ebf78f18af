"""Modules of LeRobot, which is imported where it is needed."""

import importlib
from typing import Any

from libero_env.errors import MissingPackageError


def lerobot_module(module: str) -> Any:
    """Import a module of LeRobot, such as `policies.factory`.

    Raises:
        MissingPackageError: It is not installed, or does not fit the versions beside it.
    """
    try:
        return importlib.import_module(f"lerobot.{module}")
    except (ImportError, RuntimeError, TypeError) as error:
        reason = f"LeRobot cannot be imported ({error})"
        raise MissingPackageError(reason, "`make lerobot`, which makes an environment with it") from error
