"""Check that demonstration files are complete: every array is read; shapes, ranges and counts are compared."""

import argparse
from pathlib import Path

from tqdm import tqdm

from libero.libero.utils.download_utils import datasets_folder
from libero.scripts.command import option, script
from libero_env.demos.curate import examine
from libero_env.errors import DemoError


@script(
    option("paths", nargs="*", type=Path, help="files or folders (default: the folder of the data sets)"),
    option("--num-demos", type=int, default=50, help="demonstrations expected in each file (default: 50)"),
)
def main(args: argparse.Namespace) -> int:
    """Print one line for each file; return 1 where one is broken or incomplete.

    Raises:
        DemoError: There are no files.
    """
    roots = args.paths or [datasets_folder()]
    files = [f for root in roots for f in ([root] if root.is_file() else sorted(root.rglob("*.hdf5")))]
    if not files:
        raise DemoError(f"no demonstrations in {', '.join(map(str, roots))}; get some: libero demos download")
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
    print(f"{len(files) - bad} of {len(files)} files are complete")
    return int(bad > 0)
