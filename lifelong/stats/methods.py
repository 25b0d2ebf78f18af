"""Methods compared over seeds, by Student's t: means, paired differences, equivalence, and how many seeds to add.

A run of a method is one observation of each metric. What a seed does to every method alike (the first task's weights,
the order of demonstrations) goes out of the differences, which are taken seed by seed. Nothing is pooled over methods,
so a test of two methods says the same whatever else is in the table.

With n seeds no rank or sign test has a p-value below 2 / 2ⁿ (0.0625 with five): that differences are significant rests
on their normal distribution. Error rates by simulation: experiments/comparisons.
"""

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import special

from lifelong.errors import ComparisonError
from lifelong.stats.intervals import (
    ALPHA,
    CONFIDENCE,
    UNKNOWN,
    Estimate,
    Floats,
    holm,
    mean_and_half_width,
    mean_and_standard_error,
    wilson_interval,
)
from lifelong.stats.metrics import (
    METRIC_NAMES,
    METRIC_RANGES,
    Scores,
    Transfer,
    lifelong_metrics,
    metric_values,
)

MARGIN = 0.05  # success, within which two methods count as equivalent
POWER = 0.8
LEAST_SEEDS = 3  # of a test
MOST_SEEDS = 100


@dataclass(frozen=True)
class MethodRun:
    """One run of a method.

    Attributes:
        scores: Success of the run.
        order: Identifier of its task order.
        demonstrations: Identifier of the set of demonstrations that it learned from.
    """

    scores: Scores
    seed: Hashable = None
    order: Hashable = None
    demonstrations: Hashable = None


@dataclass(frozen=True)
class SeedDifference:
    """The difference of a metric between two methods, first minus second.

    Attributes:
        estimate: Difference with its interval, for this pair alone.
        p_value: Two-sided p-value of no difference; NaN where it is not tested.
        equivalence: P-value of a difference as large as the margin or larger: small if the methods are equivalent.
        spread: Standard deviation between seeds of the difference.
    """

    estimate: Estimate
    p_value: float = np.nan
    equivalence: float = np.nan
    spread: float = np.nan


def mean_over_seeds(values: Floats, episodes: int, possible: tuple[float, float]) -> Estimate:
    """Return the mean over seeds with Student's t interval, at least as wide as Wilson's where it is a success rate.

    Five seeds of 100 % have no spread, and yet are not certain: so the interval contains Wilson's over all episodes
    together. Forgetting that is the same with every seed has the interval [0, 0] if it is 0, as of methods that keep
    each task's weights; otherwise its interval is not known.

    Args:
        values: (R,) the metric with each seed.
        episodes: Number of different episodes of all seeds together, see `Scores.episodes_of`.
        possible: Least and largest value of the metric; a success rate's are (0, 1).
    """
    mean, half = mean_and_half_width(values)
    low, high = max(mean - half, possible[0]), min(mean + half, possible[1])
    if possible != (0.0, 1.0):
        return Estimate(mean, low, high) if half > 1e-9 or mean == 0 else replace(UNKNOWN, value=mean)
    if len(values) > 1:
        ends = wilson_interval(mean * episodes, episodes)
        low, high = np.fmin(low, float(ends[0])), np.fmax(high, float(ends[1]))
    return Estimate(mean, low, high)


def paired_difference(differences: Floats, margin: float = MARGIN) -> SeedDifference:
    """Test the differences of each seed by Student's paired t.

    Args:
        differences: (R,) first method minus second with each seed.
        margin: Difference from which on methods are not equivalent.

    Returns:
        The mean difference; without tests if there are fewer than three seeds, or all differences are the same.
    """
    mean, error = mean_and_standard_error(differences)
    return _tested(mean, error, len(differences) - 1, margin, error * np.sqrt(len(differences)))


def welch_difference(first: Floats, second: Floats, margin: float = MARGIN) -> SeedDifference:
    """Test two methods that share too few seeds by Welch's t (Biometrika 1947), with Satterthwaite's degrees.

    Args:
        first: (R,) the metric of the first method with each seed.
        second: (S,) that of the second.
        margin: Difference from which on methods are not equivalent.

    Returns:
        The difference of the means; without tests if a method has fewer than three seeds, or neither varies.
    """
    value = float(first.mean() - second.mean())
    if min(len(first), len(second)) < LEAST_SEEDS:
        return SeedDifference(replace(UNKNOWN, value=value))
    a, b = (v.var(ddof=1) / len(v) for v in (first, second))
    df = (a + b) ** 2 / (a**2 / (len(first) - 1) + b**2 / (len(second) - 1)) if a + b > 0 else 0.0
    return _tested(value, np.sqrt(a + b), df, margin, np.sqrt(first.var(ddof=1) + second.var(ddof=1)))


def _tested(value: float, error: float, df: float, margin: float, spread: float) -> SeedDifference:
    """Return a difference with its t interval, test, and two one-sided tests (Schuirmann, J. Pharmacokinet. 1987)."""
    if df < 1 or not error > 1e-12:
        return SeedDifference(replace(UNKNOWN, value=value))
    half = float(special.stdtrit(df, 0.5 + CONFIDENCE / 2)) * error
    estimate = Estimate(value, value - half, value + half)
    if df < LEAST_SEEDS - 1:
        return SeedDifference(estimate)
    return SeedDifference(
        estimate,
        p_value=float(2 * special.stdtr(df, -abs(value) / error)),
        equivalence=float(special.stdtr(df, (abs(value) - margin) / error)),
        spread=float(spread),
    )


def seeds_needed(difference: float, spread: float, level: float = ALPHA, power: float = POWER) -> int | None:
    """Return the number of seeds with which a paired t test would show a difference; None for more than 100.

    By the noncentral t distribution, as R's `power.t.test`. The spread of a few seeds is itself uncertain, so the
    number is an order of magnitude.

    Args:
        difference: True mean difference.
        spread: Standard deviation between seeds of the difference.
        level: Two-sided level of the test.
        power: Probability of showing it.
    """
    if not spread > 0 or difference == 0:
        return None
    counts = np.arange(LEAST_SEEDS, MOST_SEEDS + 1)
    limit = special.stdtrit(counts - 1, 1 - level / 2)
    shift = abs(difference) / spread * np.sqrt(counts)
    missed = special.nctdtr(counts - 1, shift, limit)  # NaN where it is next to 0
    enough = np.flatnonzero(~(missed > 1 - power))
    return int(counts[enough[0]]) if len(enough) else None


def statistics(
    methods: Mapping[str, Sequence[MethodRun]],
    references: Sequence[str] = (),
    *,
    all_pairs: bool = False,
    margin: float = MARGIN,
) -> dict[str, Any]:
    """Return the metrics of every method and the differences of the planned pairs, as plain data.

    P-values are adjusted by Holm over the pairs of a metric. Two methods are one pair; of more, no pair is tested
    unless it is planned.

    Args:
        methods: Runs of each method; at least one in each.
        references: Methods that each other method is compared with.
        all_pairs: Whether every method is compared with every other instead.
        margin: Difference from which on methods are not equivalent.

    Returns:
        `metrics` by label, `differences`, `statistics`: how they were computed. NaN where something is unknown.

    Raises:
        ComparisonError: A reference is not a method, or given with `all_pairs`; or the margin is not between 0 and 1.
    """
    if all_pairs and references:
        raise ComparisonError(
            f"--all-pairs and --reference {' '.join(references)} name different pairs to compare; leave one out"
        )
    if unknown := [name for name in references if name not in methods]:
        raise ComparisonError(f"{unknown[0]!r} is not a method; there are {', '.join(methods)}")
    if not 0 < margin < 1:
        raise ComparisonError(
            f"the margin of equivalence is {margin:g}; it is a difference in success, above 0 and below 1"
        )
    methods = _comparable(methods)
    values = {label: _by_seed(runs) for label, runs in methods.items()}
    pairs = [(a, b) for b in dict.fromkeys(references) for a in methods if a != b]
    pairs = [pair for i, pair in enumerate(pairs) if pair[::-1] not in pairs[:i]]
    if all_pairs or (not references and len(methods) == 2):
        pairs = list(combinations(methods, 2))
    tables = {name: _differences(name, pairs, values, margin) for name in METRIC_NAMES}
    return {
        "metrics": {
            label: {name: _metric(name, values[label], methods[label]) for name in METRIC_NAMES}
            for label in methods
        },
        "differences": [
            {"of": a, "less": b, "metrics": {name: rows[i] for name, rows in tables.items()}}
            for i, (a, b) in enumerate(pairs)
        ],
        "statistics": {
            "interval": "Student's t over seeds (or orders, demonstrations), not narrower than Wilson's over episodes",
            "tests": "paired by seed, Student's t; Welch's t with too few common ones",
            "family": "all pairs" if all_pairs else list(references),
            "correction": "Holm, over the pairs of a metric",
            "equivalence": "two one-sided t tests",
            **{"confidence": CONFIDENCE, "alpha": ALPHA, "margin": margin, "power": POWER},
        },
    }


def spreads(runs: Sequence[MethodRun]) -> dict[str, dict[str, float]]:
    """Return the standard deviation of each metric between runs that differ in one factor alone; NaN without such.

    Returns:
        Factor (`order`, `demonstrations`, `seed`) -> metric -> deviation, pooled over the sets of such runs.
    """
    names = ("order", "demonstrations", "seed")
    found: dict[str, dict[str, float]] = {}
    for factor in names:
        sets: dict[tuple[Hashable, ...], list[list[float]]] = {}
        for run in runs:
            rest = tuple(getattr(run, name) for name in names if name != factor)
            sets.setdefault(rest, []).append(list(metric_values(run.scores).values()))
        squares = sum(np.var(rows, axis=0) * len(rows) for rows in sets.values())
        free = sum(len(rows) - 1 for rows in sets.values())
        deviations = np.sqrt(squares / free) if free else np.full(len(METRIC_NAMES), np.nan)
        found[factor] = dict(zip(METRIC_NAMES, map(float, deviations), strict=True))
    return found


def compared_transfer(own: Transfer, kinds: Collection[Transfer]) -> Transfer:
    """Return the estimate by which a run is compared: eq. 3 as published only if all runs use it."""
    return "cross_fitted" if own == "published" and {*kinds} != {"published"} else own


def _comparable(methods: Mapping[str, Sequence[MethodRun]]) -> dict[str, list[MethodRun]]:
    """Return the runs with the estimates of forward transfer by which they are compared."""
    kinds = {m.scores.transfer for runs in methods.values() for m in runs}
    return {
        label: [
            replace(m, scores=replace(m.scores, transfer=compared_transfer(m.scores.transfer, kinds)))
            for m in runs
        ]
        for label, runs in methods.items()
    }


def units(runs: Sequence[MethodRun]) -> list[Hashable]:
    """Return of each run of a method what it is a sample of: its seed, or its order and demonstrations if they vary."""
    several = len({(m.order, m.demonstrations) for m in runs}) > 1
    return [(m.order, m.demonstrations) if several else m.seed for m in runs]


def _by_seed(runs: Sequence[MethodRun]) -> dict[str, dict[Hashable, float]]:
    """Return each metric by seed; with several orders or sets of demonstrations, means over seeds by these."""
    by_unit: dict[Hashable, list[dict[str, float]]] = {}
    for unit, m in zip(units(runs), runs, strict=True):
        by_unit.setdefault(unit, []).append(metric_values(m.scores))
    return {
        name: {unit: float(np.mean([v[name] for v in rows])) for unit, rows in by_unit.items()}
        for name in METRIC_NAMES
    }


def _metric(
    name: str, by_seed: Mapping[str, Mapping[Hashable, float]], runs: Sequence[MethodRun]
) -> dict[str, Any]:
    values = np.array(list(by_seed[name].values()))
    episodes = sum(m.scores.episodes_of(name) for m in runs)
    estimate: Estimate = mean_over_seeds(values, episodes, METRIC_RANGES[name])
    if len(runs) == 1:
        estimate = getattr(lifelong_metrics(runs[0].scores), name)
    return {
        "mean": estimate.value,
        "standard_error": mean_and_standard_error(values)[1],
        "low": estimate.low,
        "high": estimate.high,
        "values": values.tolist(),
    }


def _differences(
    name: str,
    pairs: Sequence[tuple[str, str]],
    values: Mapping[str, Mapping[str, Mapping[Hashable, float]]],
    margin: float,
) -> list[dict[str, Any]]:
    """Return one metric's difference of every pair, with p-values adjusted for all of them."""
    rows = []
    for a, b in pairs:
        first, second = values[a][name], values[b][name]
        shared = [unit for unit in first if unit in second]
        by_seed = [first[unit] - second[unit] for unit in shared]
        if len(shared) >= min(LEAST_SEEDS, len(first), len(second)):
            difference = paired_difference(np.array(by_seed), margin)
        else:
            by_seed = []
            difference = welch_difference(
                np.array(list(first.values())), np.array(list(second.values())), margin
            )
        rows.append((difference, by_seed))
    adjusted = holm([d.p_value for d, _ in rows])
    equivalent = holm([d.equivalence for d, _ in rows])
    tests = max(1, int(np.isfinite(adjusted).sum()))
    low, high = METRIC_RANGES[name]
    return [
        {
            "value": d.estimate.value,
            "low": float(np.maximum(d.estimate.low, low - high)),
            "high": float(np.minimum(d.estimate.high, high - low)),
            "by_seed": by_seed if np.isfinite(d.estimate.value) else [],
            "p_value": d.p_value,
            "adjusted": p,
            "significant": p < ALPHA,
            "equivalence": d.equivalence,
            "equivalence_adjusted": q,
            "equivalent": q < ALPHA,
            "seeds": seeds_needed(d.estimate.value, d.spread, ALPHA / tests),
        }
        for (d, by_seed), p, q in zip(rows, adjusted, equivalent, strict=True)
    ]
