"""Check that demonstration files are complete: every array is read; shapes, ranges and counts are compared."""

import argparse
from pathlib import Path

from libero.libero.utils.download_utils import datasets_folder
from libero.scripts.command import option, script
from libero_env.cli.demos import check_files
from libero_env.demos.curate import find_demo_files


@script(
    option("paths", nargs="*", type=Path, help="files or folders (default: the folder of the data sets)"),
    option("--num-demos", type=int, default=50, help="demonstrations expected in each file (default: 50)"),
)
def main(args: argparse.Namespace) -> int:
    """Print one line for each file; return 1 where one is broken or incomplete."""
    files = find_demo_files(args.paths or [datasets_folder()])
    broken = check_files(files, args.num_demos)
    print(f"{len(files) - broken} of {len(files)} files are complete")
    return int(broken > 0)
