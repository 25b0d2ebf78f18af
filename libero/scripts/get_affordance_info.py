"""List the regions of objects that tasks can refer to: drawers, shelves, the inside of baskets."""

import argparse

from libero.libero.envs.objects import get_object_dict
from libero.libero.utils.object_utils import get_affordance_regions
from libero.scripts.command import option, script


@script(option("categories", nargs="*", help="such as wooden_cabinet (default: all)"))
def main(args: argparse.Namespace) -> None:
    """Print one line for each category that has regions."""
    get_affordance_regions(args.categories or get_object_dict(), verbose=True)
