"""Types and options that several subcommands share."""

import argparse

Subparsers = argparse._SubParsersAction  # argparse has no public name for it


def positive(text: str) -> int:
    """An integer of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return value


def size(text: str) -> tuple[int, int]:
    """`128` or `120x160`: (height, width), for argparse."""
    numbers = [positive(part) for part in text.split("x")]
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"{text} is neither N nor HEIGHTxWIDTH")
    return numbers[0], numbers[-1]


def pictures(args: argparse.Namespace) -> tuple[str, ...]:
    """Kinds of picture that the options ask for."""
    if getattr(args, "no_images", False):
        return ()
    depth = ("depth",) if args.depth else ()
    return ("rgb", *depth, *((f"segmentation_{args.segmentation}",) if args.segmentation else ()))
