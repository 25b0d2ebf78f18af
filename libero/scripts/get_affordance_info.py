"""Which places things have that tasks may speak of: drawers, shelves, the inside of baskets."""

import argparse
from collections.abc import Sequence

from libero.libero.envs.objects import get_object_dict
from libero.libero.utils.object_utils import get_affordance_regions
from libero.scripts.command import run


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="get_affordance_info.py", description=__doc__)
    parser.add_argument("categories", nargs="*", help="such as wooden_cabinet (default: all)")
    return run(parser, tell, argv)


def tell(args: argparse.Namespace) -> None:
    """One line for each category that has places."""
    get_affordance_regions(args.categories or get_object_dict(), verbose=True)


if __name__ == "__main__":
    raise SystemExit(main())
