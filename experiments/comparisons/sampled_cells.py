"""How far NBT and AUC of a sample of the success matrix are from those of the whole one.

    python experiments/comparisons/sampled_cells.py experiments/comparisons/matrices/*

Every recorded matrix (a line of a file: what was learned, and the success on each task so far) is sampled `--draws`
times as `eval.cells=sampled` does. Besides, each is stretched to `--tasks`: column k becomes a recorded one, of which
the success after later tasks is taken by its share of the rest. Then the error of the one drawing that all runs had in
common before `eval.cells_seed`, by method: the mean over its matrices, which no number of seeds makes smaller.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from lifelong.results.cells import measured_tasks
from lifelong.stats.metrics import area_under_curve, estimate_cells, negative_backward_transfer

STUDY = 0.3  # eval.cells_share of the study of algorithms


def read(file: Path) -> list[tuple[str, np.ndarray]]:
    """Return (method, success matrix) of each run in a file."""
    with file.open(encoding="utf-8", newline="") as lines:
        _, *rows = csv.reader(lines)
    values = np.array([[float(cell or "nan") for cell in row[3:]] for row in rows])
    size = values.shape[1]
    return [(row[0], values[i : i + size]) for i, row in enumerate(rows) if row[2] == "1"]


def sampled(tasks: int, share: float, seed: int | None) -> np.ndarray:
    """Return which cells (tasks, tasks) the sample of a seed has; None: the drawing in common."""
    found = np.zeros((tasks, tasks), dtype=bool)
    for row in range(tasks):
        found[row, measured_tasks("sampled", [row], tasks, share, seed)] = True
    return found


def stretch(matrix: np.ndarray, tasks: int, rng: np.random.Generator) -> np.ndarray:
    """Return a matrix of more tasks, whose columns are those of a recorded one."""
    size, found = len(matrix), np.full((tasks, tasks), np.nan)
    for k in range(tasks):
        column = matrix[(source := rng.integers(size - 1)) :, source]
        found[k:, k] = column[np.round(np.linspace(0, len(column) - 1, tasks - k)).astype(int)]
    return found


def errors(matrix: np.ndarray, share: float, seeds: list[int | None]) -> np.ndarray:
    """Return (seeds, 2) errors of NBT and AUC."""
    fwt, rows = np.diag(matrix), [(k, k) for k in range(len(matrix))]

    def metrics(cells: np.ndarray) -> list[float]:
        return [negative_backward_transfer(cells).mean(), area_under_curve(fwt, cells).mean()]

    masks = (sampled(len(matrix), share, seed) for seed in seeds)
    found = [metrics(estimate_cells(np.where(mask, matrix, np.nan), rows)) for mask in masks]
    return np.array(found) - metrics(matrix)


def in_common(files: list[Path]) -> list[tuple[str, str, np.ndarray]]:
    """Return (file, method, errors of NBT and AUC) of the drawing in common, largest first."""
    found = []
    for file in files:
        by_method: dict[str, list[np.ndarray]] = {}
        for method, matrix in read(file):
            by_method.setdefault(method, []).append(errors(matrix, STUDY, [None])[0])
        found += [(file.stem, method, np.mean(wrong, axis=0)) for method, wrong in by_method.items()]
    return sorted(found, key=lambda row: -abs(row[2]).max())


def main() -> None:
    """Print the share of cells, the bias and the deviation for every number of tasks and share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--tasks", type=int, default=130)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.3])
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    full = [matrix for file in args.files for _, matrix in read(file)]
    print(f"{len(full)} recorded matrices, {args.draws} samples of each")
    print(
        "| tasks | share | cells | bias NBT, AUC | deviation NBT, AUC | largest of a run |\n|---|---|---|---|---|---|"
    )
    for tasks in (10, args.tasks):
        found = [c for c in full if len(c) == tasks] or [stretch(c, tasks, rng) for c in full]
        for share in args.shares:
            wrong = np.stack([errors(c, share, rng.integers(2**31, size=args.draws).tolist()) for c in found])
            cells = sampled(tasks, share, None).sum()
            bias, spread = wrong.mean((0, 1)), wrong.std(1)
            print(
                f"| {tasks} | {share} | {cells} of {tasks * (tasks + 1) // 2} | {bias[0]:+.4f}, {bias[1]:+.4f} | "
                f"{np.sqrt((spread**2).mean(0))[0]:.4f}, {np.sqrt((spread**2).mean(0))[1]:.4f} | "
                f"{spread.max(0)[0]:.4f}, {spread.max(0)[1]:.4f} |"
            )
    print(f"\n| the drawing in common, share {STUDY} | method | error of NBT | of AUC |\n|---|---|---:|---:|")
    for stem, method, wrong in in_common(args.files):
        print(f"| {stem} | {method} | {wrong[0]:+.3f} | {wrong[1]:+.3f} |")


if __name__ == "__main__":
    main()
