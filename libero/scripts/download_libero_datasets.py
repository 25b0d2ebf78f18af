"""Fetch the demonstrations that people recorded for the benchmark; what is there already is kept."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from libero.libero.utils.download_utils import (
    DATASET_LINKS,
    check_libero_dataset,
    datasets_folder,
    libero_dataset_download,
)
from libero.scripts.command import run


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="download_libero_datasets.py", description=__doc__)
    add = parser.add_argument
    add("--download-dir", type=Path, help="folder (default: that of get_libero_path('datasets'))")
    add("--datasets", choices=("all", *DATASET_LINKS), default="all", help="which (default: all)")
    add(
        "--use-huggingface",
        action="store_true",
        help="from the Hub, each file verified, instead of as archives",
    )
    return run(parser, fetch_and_check, argv)


def fetch_and_check(args: argparse.Namespace) -> int:
    """Fetch, then say what is there; 1 where something that was asked for is missing."""
    folder = args.download_dir or datasets_folder()
    libero_dataset_download(args.datasets, folder, use_huggingface=args.use_huggingface)
    complete = check_libero_dataset(folder)
    return int(args.datasets == "all" and not complete)


if __name__ == "__main__":
    raise SystemExit(main())
