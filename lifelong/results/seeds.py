"""How many seeds would show a difference between two methods, from the variances that a comparison estimated.

A planned comparison estimates its variances, too, so its statistic follows Student's noncentral t. That is approximated
as Johnson and Welch did (Biometrika 31, 1940): T exceeds q about as often as a normal variable of mean d - q c and
variance 1 + q² (1 - c²) exceeds 0, where d is the difference in standard errors, and c the mean of an estimated
standard error over the true one.

A variance that two to five seeds estimate is too small in most cases: by half in the median with one degree of freedom.
It is divided by the median of such an estimate over the true variance, so that as many plans ask for too many seeds as
for too few (cf. Browne, Statistics in Medicine 14, 1995).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lifelong.errors import require_package
from lifelong.results.components import Components, quantiles
from lifelong.results.contrasts import Contrast
from lifelong.results.curves import Floats

MOST_SEEDS = 100
POWER = 0.8
ALPHA = 0.05
_CERTAIN_DF = 1e4  # degrees of freedom from which on a variance counts as known


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

    Starts stay as they are: their component does not shrink with seeds.

    Args:
        contrast: The pair.
        tests: Number of pairs that share `alpha` (the first step of Holm's procedure, which is Bonferroni's).
        alpha: Probability of any false difference.
    """
    seeds, parts = contrast.least_seeds, contrast.parts
    if parts.runs_df <= 0:
        return Outlook(math.nan, None)
    require_package("scipy", "train")
    parts = _median_unbiased(parts)
    counts = list(range(2, MOST_SEEDS + 1))
    found = _detectable([_with_seeds(parts, seeds, count) for count in counts], alpha / tests)
    present = float(_detectable([parts], alpha / tests)[0])
    enough = np.flatnonzero(found <= abs(contrast.estimate.value))
    return Outlook(present, counts[int(enough[0])] if len(enough) else None)


def _median_unbiased(parts: Components) -> Components:
    """Return the variance with a component of the runs that is as often too large as too small."""
    from scipy.special import chdtri

    median = float(chdtri(parts.runs_df, 0.5)) / parts.runs_df
    return replace(parts, runs=parts.runs / median)


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


def _detectable(parts: Sequence[Components], level: float) -> Floats:
    """Return (P,) smallest differences that are shown with the power."""
    from scipy.special import gammaln, ndtri

    q = quantiles(parts, np.full(len(parts), level))
    variance = np.array([c.variance for c in parts])
    shares = np.array([c.runs**2 / c.runs_df + c.starts**2 / c.starts_df for c in parts])
    df = np.full(len(parts), _CERTAIN_DF)
    np.divide(variance**2, shares, out=df, where=shares > 0)  # Satterthwaite 1946
    df = np.minimum(df, _CERTAIN_DF)
    c = np.sqrt(2 / df) * np.exp(gammaln((df + 1) / 2) - gammaln(df / 2))
    errors = q * c + ndtri(POWER) * np.sqrt(1 + q**2 * (1 - c**2))
    return np.asarray(errors * np.sqrt(variance))
