"""Argument types and options that several commands share."""

import argparse

Subparsers = argparse._SubParsersAction  # argparse has no public name for the type


def positive(text: str) -> int:
    """Return an integer of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return value


def size(text: str) -> tuple[int, int]:
    """Return (height, width) from `128` or `120x160`, for argparse."""
    numbers = [positive(part) for part in text.split("x")]
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"{text} is neither N nor HEIGHTxWIDTH")
    return numbers[0], numbers[-1]


def modalities(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the kinds of image that the options ask for, as `RenderConfig` names them."""
    if getattr(args, "no_images", False):
        return ()
    depth = ("depth",) if args.depth else ()
    return ("rgb", *depth, *((f"segmentation_{args.segmentation}",) if args.segmentation else ()))
