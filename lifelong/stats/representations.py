"""How much of a matrix, of a representation, or of Fisher information is shared or left: ranks and similarities."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def stable_rank(singular_values: Floats) -> float:
    """Return the squared Frobenius norm over the squared spectral norm (Rudelson and Vershynin 2007), from 1 on."""
    return float(np.square(singular_values).sum() / np.square(singular_values).max())


def effective_rank(singular_values: Floats) -> float:
    """Return the exponential of the entropy of the normalised singular values (Roy and Vetterli 2007, eq. 5)."""
    shares = singular_values / singular_values.sum()
    shares = shares[shares > 0]
    return float(np.exp(-(shares * np.log(shares)).sum()))


def fisher_overlap(first: Floats, second: Floats) -> float:
    """Return the overlap of two diagonal Fisher matrices: 0 for disjoint weights, 1 for the same ones.

    Both are brought to trace 1; the overlap is 1 - d² with the Fréchet distance
    d² = 1/2 tr(F + G - 2 (F G)^(1/2)) (Kirkpatrick et al. 2017, supporting information 4.3).

    Args:
        first: (N,) diagonal, at least 0.
        second: (N,) diagonal of the same weights.

    Returns:
        The overlap; NaN where one of them is zero.
    """
    if not first.any() or not second.any():
        return float("nan")
    return float(np.sqrt(first / first.sum() * (second / second.sum())).sum())


def linear_cka(first: Floats, second: Floats) -> float:
    """Return linear centred kernel alignment of two representations of the same inputs (Kornblith et al. 2019).

    It is ||Y'X||² / (||X'X|| ||Y'Y||) with centred columns and Frobenius norms, computed from Gram matrices of the
    inputs; rotations and a common scale do not change it.

    Args:
        first: (N, P) features.
        second: (N, Q) features.

    Returns:
        A number in [0, 1]; NaN where features do not vary.
    """
    x, y = (features - features.mean(0) for features in (first, second))
    gram_x, gram_y = x @ x.T, y @ y.T
    norms = np.linalg.norm(gram_x) * np.linalg.norm(gram_y)
    return float((gram_x * gram_y).sum() / norms) if norms else float("nan")


def relative_distance(first: Floats, second: Floats) -> float:
    """Return ||second - first|| / ||first||, Frobenius norms; NaN where the first is zero."""
    norm = np.linalg.norm(first)
    return float(np.linalg.norm(second - first) / norm) if norm else float("nan")
