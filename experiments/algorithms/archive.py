"""One archive of the study: every run's records, its matrix and, where there is one, its last checkpoint.

    python experiments/algorithms/archive.py study.zip --runs runs/study    # make release writes it, too

`read.py` in it computes BWT, F and NBT with nothing but Python.
"""

import argparse
import csv
import io
import lzma
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from study import EARLIER, ROOT, STUDIES, planned

from libero_env.storage import atomic_path
from lifelong.results.log import ResultLog
from lifelong.results.results import Results
from lifelong.results.run_directory import RunDirectory

READER = '''"""BWT, F and NBT of every run. Of cells that were not drawn, estimates; F is of the others."""
import csv

runs = {}
for row in csv.DictReader(open("cells.csv")):
    runs.setdefault(row["run"], {})[int(row["learned"]), int(row["task"])] = row
for run, c in runs.items():
    last = max(k for _, k in c)
    s = {at: float(row["estimate"]) for at, row in c.items()}
    best = [max(s[i, k] for i in range(k, last) if c[i, k]["episodes"] != "0") for k in range(last)]
    bwt = sum(s[last, k] - s[k, k] for k in range(last)) / last
    f = sum(b - s[last, k] for k, b in enumerate(best)) / last
    nbt = sum(sum(s[k, k] - s[t, k] for t in range(k + 1, last + 1)) / (last - k) for k in range(last)) / (last + 1)
    print(f"{run:50} BWT {bwt:+.3f}  F {f:+.3f}  NBT {nbt:+.3f}")
'''


def cells(name: str, results: Results) -> list[list[str]]:
    """Return the rows of a run's matrix: successes, episodes, and what stands for the cell in sums."""
    measured, episodes = results.success_matrix()
    estimated = results.scores().matrix
    return [
        [
            name,
            str(i),
            str(k),
            str(round(np.nan_to_num(measured[i, k]) * episodes[i, k])),
            str(episodes[i, k]),
        ]
        + [repr(float(estimated[i, k]))]
        for i in range(len(measured))
        for k in range(i + 1)
    ]


def main() -> None:
    """Write the archive."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument(
        "--runs", type=Path, default=ROOT / "runs" / "study", help="folder of the runs themselves"
    )
    args = parser.parse_args()
    rows, table = [], io.StringIO()
    with atomic_path(args.archive) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for run in (run for run in planned((*STUDIES, *EARLIER)) if run.is_done()):
            with tempfile.TemporaryDirectory() as scratch:
                results = ResultLog(run.unpack(Path(scratch)) / "results.jsonl").read()
            if not np.isnan(np.diag(results.success_matrix()[0])).any():  # all tasks at once have no matrix
                rows += cells(run.name, results)
            archive.writestr(f"records/{run.name}.json", lzma.decompress(run.record.read_bytes()))
            if (folder := run.directory(args.runs)) is not None and (
                found := RunDirectory(folder).checkpoints
            ).tasks():
                archive.write(found.task_path(found.tasks()[-1]), f"checkpoints/{run.name}.safetensors")
        writer = csv.writer(table)
        writer.writerow(["run", "learned", "task", "successes", "episodes", "estimate"])
        writer.writerows(rows)
        archive.writestr("cells.csv", table.getvalue())
        archive.writestr("read.py", READER)


if __name__ == "__main__":
    main()
