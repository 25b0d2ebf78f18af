"""Diagnose finished runs of the study while their checkpoints are there, and print what came of it over seeds.

    python experiments/algorithms/diagnosis.py run --runs runs/study   # what is missing; records/diagnosis keeps it
    python experiments/algorithms/diagnosis.py                         # tables, means with intervals over seeds

Of the frontier `sequential` (with rollouts of swapped parts), `er` 2 and 50 %, and `lora`, seeds 1 to 3; of
starts from a seen world all, and how fast tasks are relearned.
"""

import argparse
import json
import lzma
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from reading import table
from study import RECORDS, ROOT, Planned, planned

from libero_env.storage import atomic_path
from lifelong.stats.intervals import mean_and_half_width

KEPT = RECORDS / "diagnosis"
DIAGNOSED = {"frontier": ("sequential", "er 2", "er 50", "lora 16"), "starts": None}
PARTS = ("encoder", "temporal", "head")


def chosen() -> list[Planned]:
    """Return the runs that are diagnosed."""
    return [
        run
        for run in planned()
        if run.study.name in DIAGNOSED and run.seed <= 3
        if (methods := DIAGNOSED[run.study.name]) is None or run.method in methods
    ]


def file_of(run: Planned) -> Path:
    """Return where a run's diagnosis is kept."""
    return KEPT / f"{run.name}.json.xz"


def diagnose(run: Planned, directory: Path) -> None:
    """Diagnose a run and keep its numbers; with relearning, if it began with something."""
    libero = [sys.executable, "-m", "libero_cli"]
    episodes = ["--episodes", "10"] if run.name.startswith("frontier/sequential/") else []
    subprocess.run([*libero, "diagnose", directory, "--held-out", "10", *episodes], check=True)
    file_of(run).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file_of(run)) as part:
        part.write_bytes(lzma.compress((directory / "diagnosis.json").read_bytes(), preset=9))
    if run.study.name == "starts":
        subprocess.run([*libero, "relearn", directory], check=True)
        run.keep(directory)


def measures(found: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield what a diagnosis says of a run: means over its tasks, and of what the tasks lost together."""
    for name in ("error", "failures"):
        swaps = [one for one in found["swaps"] if one["measure"] == name]
        if not swaps:
            continue
        learned, final = (sum(one[key] for one in swaps) for key in ("learned", "final"))
        yield f"{name} at the end, less just learned, a task", (final - learned) / len(swaps)
        if name == "error":
            yield "error at the end, times just learned", final / learned
        for part in PARTS if final > 1.1 * learned else ():
            kept = sum(one["swapped"][part] for one in swaps)
            yield f"{name}: share of it that the {part} of then restores", (final - kept) / (final - learned)
    for place in ("features", "latents", "actions"):
        yield f"CKA of {place}", _mean(found["drifts"], "cka", place=place)
    for part in PARTS:
        yield f"update of the {part}, share of its norm", _mean(found["updates"], "relative", part=part)
    yield "KL of a task's update on its frames, nats", _mean(found["moved"], "kl")
    yield "overlap of two tasks' Fisher information", _mean(found["overlaps"], "all")


def _mean(rows: list[dict[str, Any]], key: str, **of: str) -> float:
    values = [row[key] for row in rows if all(row[name] == value for name, value in of.items())]
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")


def tables() -> Iterator[list[str]]:
    """Yield the table of each study: measures by method, means with intervals over seeds."""
    for study in DIAGNOSED:
        by_method: dict[str, list[dict[str, float]]] = {}
        for run in (run for run in chosen() if run.study.name == study and file_of(run).is_file()):
            content = json.loads(lzma.decompress(file_of(run).read_bytes()))
            by_method.setdefault(run.method, []).append(dict(measures(content)))
        names = dict.fromkeys(name for runs in by_method.values() for run in runs for name in run)
        rows = [
            [name, *(_cell([run.get(name, np.nan) for run in runs]) for runs in by_method.values())]
            for name in names
        ]
        if rows:
            yield table(["", *(f"{method} ({len(runs)})" for method, runs in by_method.items())], rows)


def _cell(values: list[float]) -> str:
    known = [value for value in values if np.isfinite(value)]
    mean, half = mean_and_half_width(known)
    ends = "" if np.isnan(half) else f" [{mean - half:z.2f}, {mean + half:z.2f}]"
    return f"{mean:z.2f}{ends}" if known else "–"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("run", "table"), nargs="?", default="table")
    parser.add_argument(
        "--runs", type=Path, default=ROOT / "runs" / "study", help="folder of the runs themselves"
    )
    args = parser.parse_args()
    for run in chosen() if args.what == "run" else ():
        directory = run.directory(args.runs)
        if run.is_done() and directory is not None and not file_of(run).is_file():
            diagnose(run, directory)
    for lines in tables():
        print("\n".join(lines), end="\n\n")


if __name__ == "__main__":
    main()
