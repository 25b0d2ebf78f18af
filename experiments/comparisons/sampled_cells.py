"""How far NBT and AUC of a sample of the success matrix are from those of the whole one.

    python experiments/comparisons/sampled_cells.py experiments/comparisons/matrices/*

Every recorded matrix is sampled `--draws` times as `eval.cells=sampled` does. Besides, each is stretched to `--tasks`:
column k becomes a recorded column, of which the success after later tasks is taken by its share of the rest.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from lifelong.results.summary import read_episodes
from lifelong.stats.metrics import area_under_curve, estimate_cells, negative_backward_transfer


def sample(matrix: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return a copy without the cells that a random sample leaves out."""
    found = matrix.copy()
    for row in range(1, len(found) - 1):
        count = row - math.ceil(share * row)
        found[row, rng.choice(row, count, replace=False)] = np.nan
    return found


def stretch(matrix: np.ndarray, tasks: int, rng: np.random.Generator) -> np.ndarray:
    """Return a matrix of more tasks, whose columns are those of a recorded one."""
    size, found = len(matrix), np.full((tasks, tasks), np.nan)
    for k in range(tasks):
        column = matrix[(source := rng.integers(size - 1)) :, source]
        found[k:, k] = column[np.round(np.linspace(0, len(column) - 1, tasks - k)).astype(int)]
    return found


def errors(matrix: np.ndarray, share: float, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Return (draws, 2) errors of NBT and AUC."""
    fwt, rows = np.diag(matrix), [(k, k) for k in range(len(matrix))]

    def metrics(cells: np.ndarray) -> list[float]:
        return [negative_backward_transfer(cells).mean(), area_under_curve(fwt, cells).mean()]

    return np.array(
        [metrics(estimate_cells(sample(matrix, share, rng), rows)) for _ in range(draws)]
    ) - metrics(matrix)


def main() -> None:
    """Print the share of cells, the bias and the deviation for every number of tasks and share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--tasks", type=int, default=130)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.3])
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    runs = [results for file in args.files for _, results in read_episodes(file)]
    full = [r.scores().matrix for r in runs]
    full = [c for c in full if len(c) > 2 and np.isfinite(c[np.tril_indices(len(c))]).all()]
    print(f"{len(full)} recorded matrices, {args.draws} samples of each")
    print(
        "| tasks | share | cells | bias NBT, AUC | deviation NBT, AUC | largest of a run |\n|---|---|---|---|---|---|"
    )
    for tasks in (10, args.tasks):
        found = [c for c in full if len(c) == tasks] or [stretch(c, tasks, rng) for c in full]
        for share in args.shares:
            wrong = np.stack([errors(c, share, args.draws, rng) for c in found])
            cells = (
                np.isfinite(sample(np.tril(np.ones((tasks, tasks))), share, rng)).sum()
                - tasks * (tasks - 1) / 2
            )
            bias, spread = wrong.mean((0, 1)), wrong.std(1)
            print(
                f"| {tasks} | {share} | {cells:.0f} of {tasks * (tasks + 1) // 2} | {bias[0]:+.4f}, {bias[1]:+.4f} | "
                f"{np.sqrt((spread**2).mean(0))[0]:.4f}, {np.sqrt((spread**2).mean(0))[1]:.4f} | "
                f"{spread.max(0)[0]:.4f}, {spread.max(0)[1]:.4f} |"
            )


if __name__ == "__main__":
    main()
