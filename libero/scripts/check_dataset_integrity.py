"""Whether demonstration files are whole: every array is read, and shapes, ranges and counts are compared."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from libero.libero.utils.download_utils import datasets_folder
from libero.scripts.command import run
from libero_env.demos.curate import examine
from libero_env.errors import DemoError


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="check_dataset_integrity.py", description=__doc__)
    parser.add_argument(
        "paths", nargs="*", type=Path, help="files or folders (default: the data sets' folder)"
    )
    parser.add_argument("--num-demos", type=int, default=50, help="expected in each file (default: 50)")
    return run(parser, check, argv)


def check(args: argparse.Namespace) -> int:
    """One line for each file; 1 where one is broken or incomplete.

    Raises:
        DemoError: there are no files.
    """
    roots = args.paths or [datasets_folder()]
    files = [f for root in roots for f in ([root] if root.is_file() else sorted(root.rglob("*.hdf5")))]
    if not files:
        raise DemoError(
            f"no demonstrations in {', '.join(map(str, roots))}; `libero demos download` fetches some"
        )
    bad = 0
    for file in tqdm(files, unit="file", disable=None):
        try:
            stats = examine(file)
            faults = [str(fault) for fault in stats.faults]
            if len(stats.lengths) != args.num_demos:
                faults.append(f"{len(stats.lengths)} demonstrations; expected {args.num_demos}")
        except DemoError as error:
            faults = [str(error)]
        bad += bool(faults)
        for fault in faults:
            tqdm.write(f"FAIL  {file}: {fault}")
        if not faults:
            tqdm.write(f"ok    {file}: {stats}")
    print(f"{len(files) - bad} of {len(files)} files are whole")
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
