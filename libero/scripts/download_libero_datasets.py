"""Download the demonstrations that people recorded for the benchmark; files that exist are kept."""

import argparse
from pathlib import Path

from libero.libero.utils.download_utils import (
    DATASET_LINKS,
    check_libero_dataset,
    datasets_folder,
    libero_dataset_download,
)
from libero.scripts.command import option, script


@script(
    option("--download-dir", type=Path, help="folder (default: that of get_libero_path('datasets'))"),
    option("--datasets", choices=("all", *DATASET_LINKS), default="all", help="data set (default: all)"),
    option("--use-huggingface", action="store_true", help="download verified files of the Hub, not archives"),
)
def main(args: argparse.Namespace) -> int:
    """Download, then print which files exist; return 1 where a requested file is missing."""
    folder = args.download_dir or datasets_folder()
    libero_dataset_download(args.datasets, folder, use_huggingface=args.use_huggingface)
    complete = check_libero_dataset(folder)
    return int(args.datasets == "all" and not complete)
