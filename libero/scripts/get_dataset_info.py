"""What a file of demonstrations holds: lengths, range of actions, instruction, observations of each demonstration."""

import argparse
from collections.abc import Sequence

from libero.libero.utils.dataset_utils import get_dataset_info
from libero.scripts.command import run


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="get_dataset_info.py", description=__doc__)
    parser.add_argument("--dataset", required=True, help="HDF5 file")
    parser.add_argument("--filter_key", help="name of a subset in `mask`")
    parser.add_argument("--verbose", action="store_true", help="each demonstration's arrays, too")
    return run(parser, tell, argv)


def tell(args: argparse.Namespace) -> int:
    """Print the findings; 1 where actions are out of range."""
    info = get_dataset_info(args.dataset, args.filter_key)
    if args.verbose:
        for name, arrays in info["structure"].items():
            print(name)
            for key, shape in arrays.items():
                print(f"    {key}: {shape}")
    within = info["action_min"] >= -1.0 and info["action_max"] <= 1.0
    if not within:
        print("actions are not in [-1, 1]")
    return int(not within)


if __name__ == "__main__":
    raise SystemExit(main())
