"""How many seeds would show a difference between two methods, from the variances that a comparison estimated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lifelong.results.components import Components, quantiles
from lifelong.results.contrasts import Contrast

MOST_SEEDS = 100
POWER = 0.8
ALPHA = 0.05


@dataclass(frozen=True)
class Outlook:
    """What more seeds would show.

    Attributes:
        detectable: Smallest difference that the present seeds show with 80 % power, at the level that all pairs leave
            to each; NaN if the spread between seeds is not known.
        seeds: Number of seeds of each method with which the observed difference would be shown with 80 % power;
            None if more than 100, or unknown.
    """

    detectable: float
    seeds: int | None


def outlook(contrast: Contrast, tests: int, alpha: float = ALPHA) -> Outlook:
    """Return what a pair's present seeds could show, and how many seeds its observed difference needs.

    The difference that is shown with power 0.8 is (t of the level + t of the power) standard errors. Starts
    stay as they are: their component does not shrink with seeds.

    Args:
        contrast: The pair.
        tests: Number of pairs that share `alpha` (the first step of Holm's procedure, which is Bonferroni's).
        alpha: Probability of any false difference.
    """
    seeds, parts = contrast.least_seeds, contrast.parts
    if parts.runs_df <= 0:
        return Outlook(math.nan, None)
    counts = list(range(2, MOST_SEEDS + 1))
    found = _detectable([_with_seeds(parts, seeds, count) for count in counts], alpha / tests)
    present = float(_detectable([parts], alpha / tests)[0])
    enough = np.flatnonzero(found <= abs(contrast.estimate.value))
    return Outlook(present, counts[int(enough[0])] if len(enough) else None)


def _with_seeds(parts: Components, seeds: int, count: int) -> Components:
    """Return the variance with another number of seeds; degrees of freedom grow with it."""
    share = seeds / count
    alone = max(parts.starts - parts.both, 0.0)  # of the starts themselves
    df = parts.runs_df * max(count - 1, 1) / max(seeds - 1, 1)
    both = parts.both * share
    return replace(
        parts,
        runs=parts.runs * share,
        starts=alone + both,
        both=both,
        runs_df=df,
        least=parts.least * share**2,
    )


def _detectable(parts: Sequence[Components], level: float) -> np.ndarray:
    """Return (P,) smallest differences that are shown with the power."""
    count = len(parts)
    t = quantiles(parts, np.full(count, level)) + quantiles(parts, np.full(count, 2 * (1 - POWER)))
    return np.asarray(t * np.sqrt([c.variance for c in parts]))
