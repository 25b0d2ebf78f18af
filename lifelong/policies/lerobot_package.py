"""LeRobot as a package: its modules, and what it refuses, said in one line."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from lifelong.errors import ConfigError, MissingPackageError


def lerobot_module(module: str) -> Any:
    """Import a module of LeRobot, such as `policies.factory`.

    Raises:
        MissingPackageError: It is not installed, or does not fit the versions beside it.
    """
    try:
        _declare_operators()
        return importlib.import_module(f"lerobot.{module}")
    except (ImportError, RuntimeError, TypeError) as error:
        reason = f"LeRobot cannot be imported ({error})"
        raise MissingPackageError(reason, "`make lerobot`, which makes an environment with it") from error


def _declare_operators() -> None:
    """Declare torchvision's operators where its build does not fit torch's, as of a CPU build; LeRobot calls none."""
    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error):
            raise
        library = torch.library.Library("torchvision", "FRAGMENT")
        _KEPT.append(library)
        for name in _OPERATORS:
            library.define(f"{name}(Tensor x) -> Tensor")
        importlib.import_module("torchvision")


_KEPT: list[Any] = []  # operators are forgotten with their library
_BACKWARD = ("roi_align", "roi_pool", "ps_roi_align", "ps_roi_pool", "deform_conv2d")
_OPERATORS = ("nms", "qnms", *_BACKWARD, *(f"_{name}_backward" for name in _BACKWARD))


@contextmanager
def settings_errors(type: str) -> Iterator[None]:
    """Turn what LeRobot raises for settings that are not valid into one line."""
    try:
        yield
    except (ValueError, NotImplementedError, TypeError) as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"policy.type={type}: LeRobot refuses its settings: {text}") from error
