"""Variance of a mean over runs that share their starts, and intervals that hold for two to five seeds.

Runs (seeds) and starts are crossed random factors: another seed gives other weights, another start another difficulty,
which is the same for all runs. No bootstrap is exact for such a table (McCullagh, Bernoulli 2000), and percentiles over
two or three seeds are far too narrow. So the variance of the mean is estimated by its components,

    A + B - C,   A = s²/R between the R runs (R - 1 degrees of freedom),
                 B = over starts, from the clusters' means over runs,
                 C = what both contain: the interaction of runs and starts,

which is the unbiased form of clustering in two ways (Cameron, Gelbach & Miller, J. Bus. Econ. Stat. 2011). The quantile
follows Cochran & Cox ("Experimental Designs", 1957, 4.14): t with R - 1 and t with the starts' degrees of freedom,
weighted by w and 1 - w, where w is A / (A + B) to a power. Theirs is 1. For intervals it is 1.25, as with 1 some cover
98.5 %; for tests 0.75 / (R - 1), as with 1 up to 6 % are false with two to five runs, and with 0.75 with three and
more. Both were chosen by simulation (experiments/comparisons). Satterthwaite's degrees of freedom cover 88 % where two
runs decide.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.errors import require_package
from lifelong.results.curves import Floats
from lifelong.results.intervals import Estimate, score_interval

INTERVAL_POWER = 1.25  # of the share of the runs' component in the quantile
TEST_POWER = 0.75  # of tests, divided by the runs' degrees of freedom
SMALLEST = 1e-60  # p-value
ONE_EPISODE = 0.96  # z²/4 at 95 %: the variance that Wilson's interval adds, in units of one episode


@dataclass(frozen=True)
class Sample:
    """One metric in several runs of a method.

    Attributes:
        units: R names of what is drawn independently: seeds, or orders of tasks if there are several.
        values: (R,) the metric.
        deviations: (R, N) of the clusters, see `lifelong.results.clusters`.
        strata: (N,) number of each cluster's stratum, from 0.
        noise: (R,) sums of the squared weights of the different rollouts; 0 where the metric cannot vary.
    """

    units: tuple[Hashable, ...]
    values: Floats
    deviations: Floats
    strata: NDArray[np.int64]
    noise: Floats

    @property
    def mean(self) -> float:
        """Mean over the runs."""
        return float(self.values.mean())

    @property
    def constant(self) -> bool:
        """Whether the metric is what it is by construction, as NBT where every column repeats its rollouts."""
        return not self.noise.any() and not self.deviations.any() and bool(np.ptp(self.values) < 1e-12)

    def of(self, units: tuple[Hashable, ...]) -> "Sample":
        """Return the runs of some units, in the order given."""
        rows = [self.units.index(u) for u in units]
        return Sample(units, self.values[rows], self.deviations[rows], self.strata, self.noise[rows])


@dataclass(frozen=True)
class Components:
    """Components of the variance of a mean, as in the module's text, and degrees of freedom.

    Attributes:
        runs: A, with what `starts` and it have in common.
        starts: B.
        both: C.
        runs_df: Degrees of freedom of A; 0 if there is a single run, so that A is unknown and taken as 0.
        starts_df: Those of B.
        least: Variance of one episode, so that nothing is certain because all succeeded.
        tested: Whether the quantile is that of a test, which gives A more weight than that of an interval.
    """

    runs: float
    starts: float
    both: float
    runs_df: float
    starts_df: float
    least: float = 0.0
    tested: bool = False

    @property
    def variance(self) -> float:
        """Variance of the mean."""
        return max(self.runs + self.starts - self.both, self.runs, self.starts) + self.least

    def quantile(self, level: float) -> float:
        """Return how many standard errors the mean exceeds, either way, in a share `level` of cases."""
        return float(quantiles([self], np.array([level]))[0])


def quantiles(parts: Sequence[Components], levels: Floats) -> Floats:
    """Return for each variance how many standard errors its mean exceeds, either way, in a share of cases.

    Args:
        parts: P variances.
        levels: (P,) shares in (0, 1].
    """
    require_package("scipy", "train")
    from scipy.special import stdtrit

    columns = np.array([(c.runs, c.starts, c.runs_df, c.starts_df, c.tested) for c in parts]).T
    runs, starts, runs_df, starts_df, tested = columns
    power = np.where(tested, TEST_POWER / np.maximum(runs_df, 1.0), INTERVAL_POWER)
    t_runs = np.where(runs_df > 0, -stdtrit(np.maximum(runs_df, 1e-3), levels / 2), 0.0)
    t_starts = -stdtrit(np.maximum(starts_df, 1.0), levels / 2)
    total = runs + starts
    share = (runs / np.where(total > 0, total, 1.0)) ** power
    found = np.where(total > 0, share * t_runs + (1 - share) * t_starts, np.maximum(t_runs, t_starts))
    return np.asarray(found)


def p_values(values: Sequence[float], parts: Sequence[Components]) -> Floats:
    """Return for each mean the probability of one at least as far from 0 if it is 0, by bisection."""
    if not parts:
        return np.zeros(0)
    variances = np.array([c.variance for c in parts])
    far = np.abs(values)
    target = far / np.sqrt(np.where(variances > 0, variances, 1.0))
    low, high = np.full(len(parts), np.log(SMALLEST)), np.zeros(len(parts))
    for _ in range(50):
        middle = (low + high) / 2
        above = quantiles(parts, np.exp(middle)) > target
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(variances > 0, np.exp(high), np.where(far < 1e-12, 1.0, SMALLEST))


def components(sample: Sample) -> Components:
    """Return the components of the variance of a sample's mean."""
    runs = len(sample.values)
    by_stratum = np.bincount(sample.strata, weights=sample.deviations.mean(axis=0) ** 2)
    sizes = np.bincount(sample.strata)
    starts = float(by_stratum.sum())
    shares = float((by_stratum**2 / np.maximum(sizes - 1, 1)).sum())
    within = float((sample.deviations**2).sum()) / runs**2  # (starts + interaction) / R
    both = max(0.0, (runs * within - starts) / (runs - 1)) if runs > 1 else 0.0
    noise = float(sample.noise.sum()) / runs**2
    return Components(
        runs=float(sample.values.var(ddof=1)) / runs if runs > 1 else 0.0,
        starts=starts,
        both=both,
        runs_df=runs - 1.0,
        starts_df=starts**2 / shares if shares > 0 else float(max(len(sample.strata) - len(sizes), 1)),
        least=ONE_EPISODE * noise**2,
    )


def interval(sample: Sample, possible: tuple[float, float], confidence: float = 0.95) -> Estimate:
    """Return the mean of a metric over its runs with its interval, within the values that it can have.

    Of a mean of success rates it is Wilson's interval with as many episodes as would have this variance if they were
    independent (Kott & Carr, J. Official Stat. 1997), so that it is right beside 0 and 1; of a difference, as NBT is,
    it is symmetric.
    """
    if not np.isfinite(sample.values).all():
        return Estimate(sample.mean, float("nan"), float("nan"))
    value, found = sample.mean, components(sample)
    if sample.constant:
        return Estimate(value, value, value)
    t = found.quantile(1 - confidence)
    if possible == (0.0, 1.0):
        most = len(sample.noise) ** 2 / sample.noise.sum()  # episodes, if all were independent
        spread, variance = value * (1 - value), found.variance - found.least
        episodes = min(spread / variance, 4 * most) if variance > 0 and spread > 0 else most
        low, high = score_interval(np.array(value * episodes), np.array(episodes), t)
        return Estimate(value, float(low), float(high))
    half = t * float(np.sqrt(found.variance))
    return Estimate(value, max(value - half, possible[0]), min(value + half, possible[1]))
