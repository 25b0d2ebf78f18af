"""The success of a run as the input of its metrics, and the formulas of Liu et al. (NeurIPS 2023), eq. 3.

c[i,j,e] is the success rate on task j after e epochs on task i, c[i,j] that of the weights that are kept of task i, K
the number of tasks. Tasks count from 0 here, from 1 in the paper.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lifelong.results.curves import Curve, Floats, Transfer

METRIC_NAMES = ("fwt", "nbt", "auc", "final_success", "just_learned")
METRIC_RANGES = {name: (-1.0 if name == "nbt" else 0.0, 1.0) for name in METRIC_NAMES}


@dataclass(frozen=True)
class Cell:
    """The episodes behind one success rate of the matrix.

    Attributes:
        row: Row of the matrix.
        column: Its column.
        task: Name of the task.
        starts: (n,) initial states.
        successes: (n,) outcomes.
        same_as: Row of the first evaluation in the column whose rollouts these repeat; `row` if they repeat none.
    """

    row: int
    column: int
    task: str
    starts: NDArray[np.int64]
    successes: NDArray[np.bool_]
    same_as: int


@dataclass(frozen=True)
class Scores:
    """The input of the metrics: the success rates of a run over K tasks.

    Attributes:
        curves: K learning curves, one for each task; empty curves make FWT and AUC undefined (NaN).
        matrix: (K, K) c[i,j], success on task j after learning task i; NaN above the diagonal.
        episodes: (K, K) number of rollouts of each cell, 0 above the diagonal.
        group_sizes: Number of tasks of each group that was learned together; () for one task at a time. K is then
            the number of groups, and each group counts as one task whose success is the mean over its tasks.
        cells: Episodes of the matrix; empty if only rates are known, which are then taken as independent.
        transfer: Estimate of forward transfer, see `lifelong.results.curves`.
    """

    curves: tuple[Curve, ...]
    matrix: Floats
    episodes: NDArray[np.int64]
    group_sizes: tuple[int, ...] = ()
    cells: tuple[Cell, ...] = ()
    transfer: Transfer = "published"

    def __post_init__(self) -> None:
        k = len(self.curves)
        if self.matrix.shape != (k, k) or self.episodes.shape != (k, k):
            raise ValueError(
                f"scores of {k} tasks need ({k}, {k}) matrices, got rates {self.matrix.shape} "
                f"and episodes {self.episodes.shape}"
            )

    @property
    def has_outcomes(self) -> bool:
        """Whether the outcome of every episode is known."""
        known = bool(self.cells) or not np.isfinite(self.matrix).any()
        return known and all(c.successes is not None for c in self.curves if len(c.rates))

    def without_first(self) -> "Scores":
        """Return the success rates without the first group's: those of the sequence after its base stage."""
        later = slice(1, None)
        cells = tuple(
            replace(c, row=c.row - 1, column=c.column - 1, same_as=c.same_as - 1)
            for c in self.cells
            if c.column
        )
        return replace(
            self,
            curves=self.curves[later],
            matrix=self.matrix[later, later],
            episodes=self.episodes[later, later],
            group_sizes=self.group_sizes[later],
            cells=cells,
        )


def negative_backward_transfer(matrix: ArrayLike) -> Floats:
    """Return (K,) NBT_k = mean over t > k of (c[k,k] - c[t,k]) (eq. 3): how much of task k is forgotten.

    No task follows the last one; its empty mean is 0 and still counts among the K terms of the average,
    as in the authors' own evaluation notebook. Of a single task it is undefined (NaN): nothing could be forgotten.
    """
    c = np.asarray(matrix, dtype=float)
    if len(c) == 1:
        return np.array([np.nan])
    drops = [(c[k, k] - c[k + 1 :, k]).mean() for k in range(len(c) - 1)]
    return np.array([*drops, 0.0][: len(c)], dtype=float)


def area_under_curve(fwt: ArrayLike, matrix: ArrayLike) -> Floats:
    """Return (K,) AUC_k = (FWT_k + sum over t > k of c[t,k]) / (number of tasks from k on) (eq. 3)."""
    c, fwt = np.asarray(matrix, dtype=float), np.asarray(fwt, dtype=float)
    size = len(c)
    return np.array([(fwt[k] + c[k + 1 :, k].sum()) / (size - k) for k in range(size)], dtype=float)


def average_success(matrix: ArrayLike) -> Floats:
    """Return (K,) the mean over j <= i of c[i,j]: success over the tasks learned so far, after each task."""
    c = np.asarray(matrix, dtype=float)
    return np.array([c[i, : i + 1].mean() for i in range(len(c))], dtype=float)


def matrix_weights(size: int) -> dict[str, Floats]:
    """Return (K, K) weights of every metric: metric = sum of weight · rate, plus the learning curves' part."""
    rows, cols = np.indices((size, size))
    later = size - 1 - cols  # tasks learned after column k
    lost = np.where(rows > cols, -1 / np.maximum(later, 1), np.where(rows == cols, later > 0, 0.0)) / size
    return {
        "fwt": np.zeros((size, size)),
        "nbt": lost if size > 1 else np.full((1, 1), np.nan),
        "auc": np.where(rows > cols, 1 / (later + 1), 0.0) / size,
        "final_success": (rows == size - 1) / size,
        "just_learned": (rows == cols) / size,
    }


def curve_weights(size: int) -> dict[str, Floats]:
    """Return (K,) weights of FWT_k in every metric."""
    none = np.zeros(size)
    weights = {"fwt": np.full(size, 1 / size), "auc": 1 / (size - np.arange(size)) / size}
    return {name: weights.get(name, none) for name in METRIC_NAMES}
