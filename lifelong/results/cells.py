"""Which cells of the success matrix a run measures."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

MatrixCells = Literal["all", "diagonal", "last_row", "diagonal_and_last_row", "sampled"]


def measured_tasks(
    cells: MatrixCells, stage: Sequence[int], tasks: int, share: float = 1.0, seed: int | None = None
) -> Sequence[int]:
    """Return the tasks that are measured after a stage, ascending: its row of the success matrix.

    Args:
        stage: Positions of the tasks that were learned together last, ascending and without gaps.
        share: Share of the earlier tasks that `sampled` measures in each row but the last.
        seed: Seed by which these are drawn; None for the one drawing that all runs had in common.
    """
    final = stage[-1] == tasks - 1
    if cells == "all" or (final and cells != "diagonal"):
        return range(stage[-1] + 1)
    if cells == "last_row":
        return range(0)
    earlier = sampled_tasks(stage[0], share, seed) if cells == "sampled" else []
    return [*earlier, *range(stage[0], stage[-1] + 1)]


def sampled_tasks(earlier: int, share: float, seed: int | None) -> list[int]:
    """Return a share, rounded up, of the tasks before position `earlier`, drawn uniformly without replacement."""
    draws = np.random.default_rng(earlier if seed is None else (seed, earlier))
    return sorted(draws.choice(earlier, math.ceil(share * earlier), replace=False).tolist())
