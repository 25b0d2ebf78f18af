"""Which cells of the success matrix a run measures."""

from collections.abc import Sequence
from typing import Literal

MatrixCells = Literal["all", "diagonal", "last_row", "diagonal_and_last_row"]


def measured_tasks(cells: MatrixCells, stage: Sequence[int], tasks: int) -> range:
    """Return the tasks that are measured after a stage: its row of the success matrix.

    Args:
        cells: Cells that the run measures.
        stage: Positions of the tasks that were learned together last, ascending and without gaps.
        tasks: Number of tasks of the run.
    """
    final = stage[-1] == tasks - 1
    if cells == "all" or (final and cells != "diagonal"):
        return range(stage[-1] + 1)
    return range(0) if cells == "last_row" else range(stage[0], stage[-1] + 1)
