"""Argument types and options that several commands share. A value out of range ends in argparse's one line."""

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path

Subparsers = argparse._SubParsersAction  # argparse has no public name for the type

MAX_SIDE = 1024  # pixels, as in libero_env.sim.render, which is slow to import
MAX_PROCESSES = 1024  # also of threads
MAX_STEPS = 1_000_000  # of an episode; 14 hours
MAX_SEED = 2**63 - 1  # what HDF5 and JSON readers keep


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return a type of whole numbers for argparse.

    Args:
        least: Smallest number.
        most: Largest number; None for any.
    """
    expected = (
        f"a whole number of at least {least}" if most is None else f"a whole number from {least} to {most}"
    )

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {expected}") from None
        if value < least or (most is not None and value > most):
            raise argparse.ArgumentTypeError(f"{text} is not {expected}")
        return value

    return read


def number(least: float, most: float, *, open_ends: bool = False) -> Callable[[str], float]:
    """Return a type of finite numbers for argparse.

    Args:
        least: Lower end of the range.
        most: Upper end of the range.
        open_ends: Whether the ends themselves are excluded.
    """
    expected = (
        f"a number between {least:g} and {most:g}" if open_ends else f"a number from {least:g} to {most:g}"
    )

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        inside = least < value < most if open_ends else least <= value <= most
        if not (inside and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")
        return value

    return read


positive = whole(1)
seed = whole(0, MAX_SEED)
processes = whole(1, MAX_PROCESSES)
processes_or_all = whole(0, MAX_PROCESSES)  # 0: one for each core
horizon = whole(1, MAX_STEPS)
side = whole(1, MAX_SIDE)
share = number(0, 1)
probability = number(0, 1, open_ends=True)
seconds = number(0, 1e6, open_ends=True)


def device(text: str) -> str:
    """Return the name of a device of PyTorch; whether this machine has it is seen when it is used."""
    if not re.fullmatch(r"auto|cpu|mps|xpu|cuda(:\d{1,3})?", text):
        raise argparse.ArgumentTypeError(f"{text!r} is none of auto, cpu, cuda, cuda:1, ..., mps, xpu")
    return text


def path(text: str) -> Path:
    """Return the path of a file or folder, which need not exist."""
    if not text.strip():
        raise argparse.ArgumentTypeError("a path is needed, not an empty text; this folder is .")
    return Path(text)


def size(text: str) -> tuple[int, int]:
    """Return (height, width) from `128` or `120x160`, for argparse."""
    numbers = [side(part) for part in text.split("x")]
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"{text} is neither N nor HEIGHTxWIDTH")
    return numbers[0], numbers[-1]


def modalities(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the kinds of image that the options ask for, as `RenderConfig` names them."""
    if getattr(args, "no_images", False):
        return ()
    depth = ("depth",) if args.depth else ()
    return ("rgb", *depth, *((f"segmentation_{args.segmentation}",) if args.segmentation else ()))
