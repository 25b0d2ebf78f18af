"""Bootstrap intervals over orders, runs and episodes: their coverage and properties."""

import dataclasses

import numpy as np
import pytest

from lifelong.results.bootstrap import Member, resample
from lifelong.results.metrics import METRIC_NAMES, Curve, Scores, lifelong_metrics

pytestmark = pytest.mark.unit
TRUTH = 0.6


def scores(rng: np.random.Generator, level: float, size: int = 4, episodes: int = 20) -> Scores:
    """Success drawn at one level everywhere: FWT, AUC and final success are that level, NBT is 0."""
    draw = lambda shape: rng.binomial(episodes, np.clip(level, 0, 1), shape) / episodes  # noqa: E731
    matrix = np.where(np.tril(np.ones((size, size))) > 0, draw((size, size)), np.nan)
    curves = tuple(Curve(np.arange(3), draw(3), np.full(3, episodes)) for _ in range(size))
    return Scores(curves, matrix, np.tril(np.full((size, size), episodes)))


def members(
    seed: int, runs: int, spread: float, orders: int = 1, order_spread: float = 0.0, **kwargs
) -> list[Member]:
    rng = np.random.default_rng(seed)
    found = []
    for order in range(orders):
        middle = TRUTH + order_spread * rng.normal()
        found += [Member(scores(rng, middle + spread * rng.normal(), **kwargs), order) for _ in range(runs)]
    return found


def width(estimate) -> float:
    return estimate.high - estimate.low


def test_the_same_seed_gives_the_same_interval_and_another_one_nearly():
    group = members(0, runs=4, spread=0.1)
    first, again, other = (resample(group, seed=s) for s in (1, 1, 2))
    for name in METRIC_NAMES:
        assert first.interval(name) == again.interval(name)
        assert first.interval(name) != other.interval(name)
        assert first.interval(name).low == pytest.approx(other.interval(name).low, abs=0.02)


def test_the_middle_is_the_mean_over_runs():
    group = members(1, runs=3, spread=0.1, orders=2)
    found = resample(group)
    for name in METRIC_NAMES:
        mean = np.mean([getattr(lifelong_metrics(m.scores), name).value for m in group])
        assert found.values[name] == pytest.approx(mean)
        assert found.draws[name].mean() == pytest.approx(mean, abs=0.01)
        assert found.interval(name).low < mean < found.interval(name).high


def test_a_single_run_has_the_interval_of_its_episodes():
    (member,) = members(2, runs=1, spread=0.0)
    found, wilson = resample([member]), lifelong_metrics(member.scores)
    for name in METRIC_NAMES:
        assert width(found.interval(name)) == pytest.approx(width(getattr(wilson, name)), rel=0.15)


def test_intervals_have_width_where_all_episodes_succeed():
    member = members(3, runs=1, spread=0.0)[0]
    perfect = dataclasses.replace(
        member.scores,
        matrix=np.where(np.isnan(member.scores.matrix), np.nan, 1.0),
        curves=tuple(dataclasses.replace(c, rates=np.ones(3)) for c in member.scores.curves),
    )
    for name in METRIC_NAMES:
        assert width(resample([Member(perfect)]).interval(name)) > 0.02


def test_spread_between_runs_and_between_orders_widens():
    alike = resample(members(4, runs=6, spread=0.0)).interval("final_success")
    differing = resample(members(4, runs=6, spread=0.15)).interval("final_success")
    assert width(differing) > 1.5 * width(alike)
    group = members(5, runs=3, spread=0.0, orders=3, order_spread=0.15)
    by_order = resample(group).interval("final_success")
    as_runs = resample([Member(m.scores) for m in group]).interval("final_success")
    assert width(by_order) > 1.2 * width(as_runs), "runs of one order are no independent evidence"


@pytest.mark.parametrize(("runs", "spread", "least"), [(3, 0.0, 0.92), (8, 0.08, 0.87)])
def test_intervals_cover_the_truth(runs: int, spread: float, least: float):
    rounds, hits = 120, 0
    for seed in range(rounds):
        group = members(100 + seed, runs, spread, size=3)
        interval = resample(group, seed=seed, draws=300).interval("final_success")
        hits += interval.low <= TRUTH <= interval.high
    assert hits / rounds >= least


def test_differences_are_of_independent_groups():
    good = resample(members(6, runs=4, spread=0.02), seed=1)
    poor = resample([Member(scores(np.random.default_rng(i), 0.3)) for i in range(4)], seed=2)
    difference = good.difference(poor, "final_success")
    assert difference.value == pytest.approx(good.values["final_success"] - poor.values["final_success"])
    assert 0 < difference.low < difference.value < difference.high
    assert width(difference) > max(
        width(good.interval("final_success")), width(poor.interval("final_success"))
    )
    back = poor.difference(good, "final_success")
    assert (back.low, back.high) == pytest.approx((-difference.high, -difference.low))


def test_undefined_metrics_stay_undefined():
    member = members(7, runs=1, spread=0.0)[0]
    empty = Curve(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))
    cut = dataclasses.replace(member.scores, curves=(*member.scores.curves[:-1], empty))
    found = resample([Member(cut)])
    assert np.isnan(found.interval("fwt").low) and np.isnan(found.interval("auc").value)
    assert np.isfinite(found.interval("nbt").low)
    with pytest.raises(ValueError, match="at least one run"):
        resample([])


def test_of_tasks_learned_jointly_only_final_success_is_known():
    episodes = np.zeros((4, 4), int)
    episodes[-1] = 20
    matrix = np.where(episodes > 0, 0.5, np.nan)
    nothing = Curve(np.zeros(0, int), np.zeros(0), np.zeros(0, int))
    found = resample([Member(Scores((nothing,) * 4, matrix, episodes))])
    assert found.interval("final_success").low < 0.5 < found.interval("final_success").high
    for name in set(METRIC_NAMES) - {"final_success"}:
        assert np.isnan(found.values[name]) and np.isnan(found.interval(name).low)
