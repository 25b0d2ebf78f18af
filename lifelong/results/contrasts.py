"""Differences between methods: paired by seed and start, tested, and corrected for many pairs.

A pair is compared on the seeds that both have (all, unpaired, if these are fewer than two) and on the same starts. What
a seed does to every method alike (the first task's weights, the order of demonstrations) is removed as a block. With
two to five seeds each method's own variance is hardly known, so it is pooled with the mean of all methods', which
counts as `PRIOR_DF` degrees of freedom (Smyth, Stat. Appl. Genet. Mol. Biol. 2004, with the weight fixed, as it cannot
be estimated from a dozen methods), and is never taken to be less than its own estimate: a method whose seeds differ far
more than others' would otherwise be found to differ too often. The p-values of all pairs are adjusted by Holm (Scand.
J. Stat. 1979). Error rates by simulation: experiments/comparisons.
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lifelong.results.components import (
    ONE_EPISODE,
    Components,
    Sample,
    components,
    p_values,
    quantiles,
)
from lifelong.results.intervals import Estimate, holm

PRIOR_DF = 2.0


@dataclass(frozen=True)
class Contrast:
    """The difference of a metric between two methods, first minus second.

    Attributes:
        first: Label of the first.
        second: Label of the second.
        estimate: Difference with its interval, for this pair alone.
        p_value: Probability of a difference as large if there is none; NaN where no method has a second seed, so that
            nothing says how far seeds differ. The interval is then one over starts only.
        adjusted: The p-value adjusted for all pairs; below 0.05, the difference is significant.
        pairs: Number of seeds (or orders) that both have and that are compared; 0 if they are compared unpaired.
        least_seeds: Number of seeds that are compared of the method that has fewer.
        parts: Components of the variance.
    """

    first: str
    second: str
    estimate: Estimate
    p_value: float
    adjusted: float
    pairs: int
    least_seeds: int
    parts: Components


@dataclass(frozen=True)
class Spread:
    """Variance of a metric between the runs of a method.

    Attributes:
        variance: The variance.
        df: Its degrees of freedom.
        most: Degrees of freedom of all methods together, which no combination of theirs exceeds.
    """

    variance: float
    df: float
    most: float


def contrasts(
    samples: Mapping[str, Sample], possible: tuple[float, float] = (-1.0, 1.0), confidence: float = 0.95
) -> list[Contrast]:
    """Compare every pair of methods in one metric.

    Args:
        samples: Runs of each method, with the same clusters. Methods without the metric (NaN) are left out.
        possible: Values that a difference can have.
        confidence: Of the intervals.
    """
    known = {label: s for label, s in samples.items() if np.isfinite(s.values).all()}
    paired, single = spreads(known, blocks=True), spreads(known, blocks=False)
    names, values, parts, pairs, least = [], [], [], [], []
    for a, b in combinations(known, 2):
        shared = tuple(u for u in known[a].units if u in known[b].units)
        if len(shared) < 2 < len(known[a].units) + len(known[b].units):
            shared = ()
        spread = paired if shared else single
        value, part = _difference(known[a], known[b], spread[a], spread[b], shared)
        names.append((a, b))
        values.append(value)
        parts.append(part)
        pairs.append(len(shared))
        least.append(len(shared) or min(len(known[a].units), len(known[b].units)))
    if not names:
        return []
    halves = quantiles(parts, np.full(len(parts), 1 - confidence)) * np.sqrt([c.variance for c in parts])
    certain = [known[a].constant and known[b].constant for a, b in names]
    p = [
        value if same or part.runs_df > 0 else float("nan")
        for value, same, part in zip(p_values(values, parts).tolist(), certain, parts, strict=True)
    ]
    ends = [
        Estimate(value, max(value - half, possible[0]), min(value + half, possible[1]))
        for value, half in zip(values, halves.tolist(), strict=True)
    ]
    return [
        Contrast(*labels, *rest)
        for labels, *rest in zip(names, ends, p, holm(p), pairs, least, parts, strict=True)
    ]


def spreads(samples: Mapping[str, Sample], *, blocks: bool) -> dict[str, Spread]:
    """Estimate the variance between runs of every method, partly pooled over all methods whose metric varies.

    Args:
        samples: Runs of each method.
        blocks: Whether what a seed does to all methods alike is removed.
    """
    moving = {label: s for label, s in samples.items() if not s.constant}
    own = {label: Spread(0.0, 0.0, 0.0) for label in samples} | _residuals(moving, blocks)
    total = sum(own[label].df for label in moving)
    mean = sum(own[label].variance * own[label].df for label in moving) / total if total > 0 else 0.0
    found = {}
    for label, spread in own.items():
        pooled = label in moving and (len(moving) > 2 or spread.df == 0)
        prior = min(PRIOR_DF, total - spread.df) if pooled else 0.0
        df = spread.df + prior
        variance = (spread.df * spread.variance + prior * mean) / df if df > 0 else 0.0
        found[label] = Spread(max(variance, spread.variance), df, total)
    return found


def _residuals(samples: Mapping[str, Sample], blocks: bool) -> dict[str, Spread]:
    """Return each method's variance from the residuals of method + seed (least squares), and its part of their df."""
    rows = [(label, unit) for label, s in samples.items() for unit in s.units]
    if not rows:
        return {}
    values = np.concatenate([s.values for s in samples.values()])
    common: dict[Hashable, int] = {}
    for unit in dict.fromkeys(u for _, u in rows):
        if blocks and sum(u == unit for _, u in rows) > 1:
            common[unit] = len(common)
    labels = list(samples)
    design = np.zeros((len(rows), len(labels) + len(common)))
    for i, (label, unit) in enumerate(rows):
        design[i, labels.index(label)] = 1
        if unit in common:
            design[i, len(labels) + common[unit]] = 1
    hat = design @ np.linalg.pinv(design)
    rest, freedom = (values - hat @ values) ** 2, 1 - np.diag(hat)
    found = {}
    for label in labels:
        mine = [i for i, (name, _) in enumerate(rows) if name == label]
        df = float(freedom[mine].sum())
        known = df > 1e-9
        found[label] = Spread(float(rest[mine].sum()) / df if known else 0.0, df if known else 0.0, 0.0)
    return found


def _difference(
    a: Sample, b: Sample, of_a: Spread, of_b: Spread, shared: tuple[Hashable, ...]
) -> tuple[float, Components]:
    """Return the difference of two means and the components of its variance."""
    if shared:
        a, b = a.of(shared), b.of(shared)
        both = Sample(
            shared, a.values - b.values, a.deviations - b.deviations, a.strata, np.zeros(len(shared))
        )
        parts = components(both)
    else:
        mean = (a.deviations.mean(axis=0) - b.deviations.mean(axis=0))[None]
        parts = components(Sample((None,), np.zeros(1), mean, a.strata, np.zeros(1)))
        parts = replace(parts, both=components(a).both + components(b).both)
    of_runs = [(s.variance / len(m.values), s.df) for s, m in ((of_a, a), (of_b, b))]
    between = sum(v for v, _ in of_runs)
    shares = sum(v**2 / df for v, df in of_runs if df > 0)
    least = sum(ONE_EPISODE * (m.noise.sum() / len(m.noise) ** 2) ** 2 for m in (a, b))
    # Without a known spread between runs the difference is that of these weights.
    return a.mean - b.mean, replace(
        parts,
        runs=between,
        runs_df=min(between**2 / shares, of_a.most) if shares > 0 else 0.0,
        both=min(parts.both, between),
        least=float(least),
        tested=True,
    )
