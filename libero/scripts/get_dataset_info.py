"""Print what a demonstration file holds: lengths, range of actions, instruction, and observations."""

import argparse

from libero.libero.utils.dataset_utils import get_dataset_info
from libero.scripts.command import option, script


@script(
    option("--dataset", required=True, help="HDF5 file"),
    option("--filter_key", help="name of a subset in `mask`"),
    option("--verbose", action="store_true", help="print the arrays of each demonstration, too"),
)
def main(args: argparse.Namespace) -> int:
    """Print the facts about a file; return 1 where actions are out of range."""
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
