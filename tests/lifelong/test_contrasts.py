"""Intervals of metrics and tests of differences: what they promise, and by simulation that they hold."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from lifelong.report.statistics import findings, statistics
from lifelong.results.clusters import contributions
from lifelong.results.components import Components, Sample, components, interval, p_values, quantiles
from lifelong.results.contrasts import contrasts, spreads
from lifelong.results.curves import Curve
from lifelong.results.intervals import holm
from lifelong.results.metrics import lifelong_metrics
from lifelong.results.samples import Member, samples
from lifelong.results.scores import METRIC_NAMES, METRIC_RANGES, Cell, Scores
from lifelong.results.seeds import outlook
from lifelong.results.summary import json_safe

scipy_stats = pytest.importorskip("scipy.stats")
pytestmark = pytest.mark.unit
EXPERIMENT = Path(__file__).parents[2] / "experiments" / "comparisons"


@pytest.fixture
def simulation(monkeypatch):
    """The modules of experiments/comparisons."""
    monkeypatch.syspath_prepend(str(EXPERIMENT))
    import interval_coverage
    import model

    return model, interval_coverage


def run(rng: np.random.Generator, tasks: int = 5, starts: int = 10, level: float = 0.7, repeat: bool = False):
    """Scores with outcomes; `repeat` gives every row the rollouts of the column's first."""
    matrix, cells = np.full((tasks, tasks), np.nan), []
    for column in range(tasks):
        first = rng.random(starts) < level
        for row in range(column, tasks):
            won = first if repeat else rng.random(starts) < level
            same = column if repeat else row
            cells.append(Cell(row, column, f"task {column}", np.arange(starts), won, same))
            matrix[row, column] = won.mean()
    curves = []
    for task in range(tasks):
        won = (rng.random((3, 5, 1)) < level).astype(float)
        epochs, count = np.arange(3), np.full(3, 5)
        curves.append(Curve(epochs, won.mean((1, 2)), count, won, np.arange(45, 50), (f"task {task}",)))
    counts = np.tril(np.full((tasks, tasks), starts))
    return Scores(tuple(curves), matrix, counts, (), tuple(cells), "plain")


def width(estimate) -> float:
    return estimate.high - estimate.low


def test_repeated_rollouts_make_no_interval_narrower_and_leave_nothing_to_forget():
    scores = run(np.random.default_rng(0), repeat=True)
    found = lifelong_metrics(scores)
    assert (found.nbt.value, found.nbt.low, found.nbt.high) == (0, 0, 0)
    assert width(found.final_success) == pytest.approx(width(found.just_learned))
    assert found.final_success == found.just_learned
    as_rates = lifelong_metrics(dataclasses.replace(scores, cells=()))
    assert width(found.auc) > 1.3 * width(as_rates.auc), "five rows of one rollout are one rollout"


def test_forgetting_that_is_zero_by_luck_has_an_interval():
    scores = run(np.random.default_rng(0), level=1.0)
    found = lifelong_metrics(scores)
    assert found.nbt.value == 0 and found.nbt.low < 0 < found.nbt.high
    for name in set(METRIC_NAMES) - {"nbt"}:
        estimate = getattr(found, name)
        assert estimate.low < estimate.value == estimate.high == 1, "Wilson's interval at the end"


def test_deviations_estimate_the_variance_over_starts():
    """Against the textbook variance of a mean of independent task columns of repeated rollouts."""
    scores = run(np.random.default_rng(1), repeat=True)
    found = contributions(scores)
    columns = [c.successes for c in scores.cells if c.row == c.column]
    expected = sum(c.var(ddof=1) / len(c) for c in columns) / len(columns) ** 2
    assert (found.deviations["final_success"] ** 2).sum() == pytest.approx(expected)
    assert not found.deviations["nbt"].any()


def test_two_methods_are_compared_by_the_paired_t_test_where_starts_do_not_matter():
    rng = np.random.default_rng(2)
    a, b = rng.normal(0.6, 0.1, 4), rng.normal(0.5, 0.1, 4)
    nothing = [np.zeros((4, 6)), np.zeros(6, np.int64), np.zeros(4)]
    (found,) = contrasts({"a": Sample((1, 2, 3, 4), a, *nothing), "b": Sample((1, 2, 3, 4), b, *nothing)})
    expected = scipy_stats.ttest_rel(a, b)
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-6)
    low, high = expected.confidence_interval()
    assert (found.estimate.low, found.estimate.high) == pytest.approx((low, high))
    assert found.pairs == 4


def test_seeds_are_paired_by_name_and_not_by_place():
    values = np.array([0.2, 0.5, 0.8])
    nothing = [np.zeros((3, 4)), np.zeros(4, np.int64), np.zeros(3)]
    a = Sample((1, 2, 3), values, *nothing)
    b = Sample((3, 1, 2), values[[2, 0, 1]] + np.array([0.11, 0.1, 0.09]), *nothing)
    (found,) = contrasts({"a": a, "b": b})
    assert found.estimate.value == pytest.approx(-0.1)
    assert found.p_value < 0.01
    other = dataclasses.replace(b, units=(7, 8, 9))
    (apart,) = contrasts({"a": a, "b": other})
    assert apart.pairs == 0 and apart.p_value > 0.3


def test_starts_that_both_share_cancel():
    rng = np.random.default_rng(3)
    hard = rng.normal(0, 0.02, (1, 40))
    rest = [np.zeros(40, np.int64), np.full(3, 0.001)]
    of = lambda: Sample((1, 2, 3), rng.normal(0.5, 0.01, 3), hard + rng.normal(0, 1e-3, (3, 40)), *rest)  # noqa: E731
    a, b = of(), of()
    (found,) = contrasts({"a": a, "b": b})
    assert found.parts.starts < 0.05 * (components(a).starts + components(b).starts)


def test_spreads_are_pooled_but_not_for_two_and_not_with_what_cannot_vary():
    nothing = lambda v: Sample((1, 2), np.array(v), np.zeros((2, 4)), np.zeros(4, np.int64), np.full(2, 0.01))  # noqa: E731
    two = {"a": nothing([0.4, 0.6]), "b": nothing([0.5, 0.5])}
    assert sum(s.df for s in spreads(two, blocks=False).values()) == pytest.approx(2)
    several = two | {"c": nothing([0.3, 0.35]), "d": nothing([0.1, 0.3])}
    pooled, own = spreads(several, blocks=False), [v.values.var(ddof=1) for v in several.values()]
    assert pooled["b"].variance == pytest.approx(2 / 3 * np.mean(own))
    assert pooled["b"].df == pytest.approx(3)
    assert pooled["a"].variance == pytest.approx(max(own)), "not less than its own"
    frozen = dataclasses.replace(nothing([0.0, 0.0]), noise=np.zeros(2))
    with_frozen = spreads(several | {"frozen": frozen}, blocks=True)
    assert with_frozen["frozen"].variance == 0
    assert with_frozen["b"] == spreads(several, blocks=True)["b"]


def test_holm_against_an_example_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0] and holm([]) == []
    assert holm([0.01, np.nan, 0.04]) == pytest.approx([0.02, np.nan, 0.04], nan_ok=True), "not tested"


def test_quantiles_and_p_values_are_inverse():
    parts = [Components(0.002, 0.001, 0.0003, df, 80.0, 1e-6) for df in (1.0, 2.0, 7.5, 0.0)]
    levels = np.array([0.05, 0.3, 1e-6, 0.01])
    values = quantiles(parts, levels) * np.sqrt([c.variance for c in parts])
    assert p_values(values.tolist(), parts) == pytest.approx(levels, rel=1e-6)
    assert quantiles(parts[:1], np.array([0.05]))[0] < scipy_stats.t.ppf(0.975, 1)
    certain = Components(0.0, 0.0, 0.0, 1.0, 80.0)
    assert p_values([0.0, 0.1], [certain, certain]).tolist() == [1.0, 1e-60]


def test_a_seed_more_shows_less_and_a_large_difference_needs_fewer(simulation):
    model, _ = simulation
    rng, design = np.random.default_rng(5), model.Design(5, 10, 3)
    methods = [model.Method(level, 0.9) for level in (0.75, 0.7, 0.3)]
    found = [model.samples_of(o, design) for o in model.simulate(methods, design, rng)]
    near, far, _ = contrasts({str(i): row["final_success"] for i, row in enumerate(found)})
    assert (outlook(near, 3).seeds or 101) > (outlook(far, 3).seeds or 101)
    assert outlook(near, 3).detectable < outlook(near, 200).detectable
    assert outlook(far, 3).seeds is not None
    single = {str(i): row["final_success"].of((0,)) for i, row in enumerate(found[:2])}
    (alone,) = contrasts(single)
    assert np.isnan(outlook(alone, 1).detectable) and outlook(alone, 1).seeds is None


def test_the_seeds_asked_for_show_the_difference_as_often_as_promised():
    """In four of five experiments; 62 % where a variance from three seeds is taken as it is."""
    rng = np.random.default_rng(0)

    def compared(seeds: int):
        nothing = [np.zeros((seeds, 4)), np.zeros(4, np.int64), np.full(seeds, 1e-9)]
        values = {"a": rng.normal(0.50, 0.05, seeds), "b": rng.normal(0.56, 0.05, seeds)}
        (pair,) = contrasts({name: Sample(tuple(range(seeds)), v, *nothing) for name, v in values.items()})
        return pair

    def asked_for(pair) -> int:
        known = dataclasses.replace(pair, estimate=dataclasses.replace(pair.estimate, value=0.06))
        return outlook(known, 1).seeds or 101

    seeds = int(np.median([asked_for(compared(3)) for _ in range(150)]))
    assert 0.72 <= np.mean([compared(seeds).p_value < 0.05 for _ in range(200)]) <= 0.92


def test_the_simulated_samples_are_those_of_runs(simulation):
    model, _ = simulation
    for reporting in (False, True):
        design = model.Design(4, 10, 3, reporting=reporting)
        methods = [model.Method(0.75, 0.9), model.Method(0.8, frozen=True)]
        outcomes = model.simulate(methods, design, np.random.default_rng(6))
        of_runs = samples({str(i): model.members_of(o, design) for i, o in enumerate(outcomes)})
        for number, one in enumerate(outcomes):
            for name, sample in model.samples_of(one, design).items():
                found = of_runs[name][str(number)]
                assert found.values == pytest.approx(sample.values)
                expected = dataclasses.astuple(components(sample))
                assert dataclasses.astuple(components(found)) == pytest.approx(expected)


@pytest.mark.parametrize("seeds", [2, 3, 5])
def test_intervals_hold(simulation, seeds: int):
    """A short version of experiments/comparisons; percentiles of two or three seeds cover 60 to 85 %."""
    model, coverage = simulation
    found = coverage.coverage(model.Design(5, 10, seeds), 40, np.random.default_rng(seeds))
    shares = {(m, n): pair[0] for m, row in found.items() for n, pair in row.items()}
    assert min(shares.values()) >= 0.85, shares
    of_spread = [v for (m, n), v in shares.items() if n != "nbt" and m != "near 100 %"]
    assert 0.93 <= np.mean(of_spread) <= 0.99
    assert found["frozen"]["nbt"] == [1.0, 0.0]


def test_intervals_of_one_run_hold_for_its_starts(simulation):
    model, coverage = simulation
    found = coverage.coverage_of_single_runs(model.Design(5, 10, 1), 80, np.random.default_rng(7))
    for method, row in found.items():
        for name, (share, _) in row.items():
            assert share >= 0.86, (method, name)


@pytest.mark.parametrize(("methods", "seeds"), [(2, 2), (8, 2), (8, 3)])
def test_equal_methods_differ_significantly_in_at_most_one_of_twenty_comparisons(
    simulation, methods: int, seeds: int
):
    model, coverage = simulation
    design, rng = model.Design(5, 10, seeds), np.random.default_rng(methods)
    found = coverage.false_differences(coverage.equal_methods(methods), design, 40, rng)
    for name, (pairs, family) in found.items():
        assert pairs <= 0.15, name
        assert family <= 0.15, name  # 0.05 and three standard errors of 40


def test_single_runs_are_not_tested_but_those_of_methods_that_cannot_vary_are_equal(simulation):
    """However many starts there are: nothing says how far another seed would be."""
    model, _ = simulation
    design, rng = model.Design(5, 10, 1), np.random.default_rng(11)
    methods = [
        model.Method(0.9),
        model.Method(0.2),
        model.Method(0.5, frozen=True),
        model.Method(frozen=True),
    ]
    found = [model.samples_of(o, design) for o in model.simulate(methods, design, rng)]
    pairs = contrasts({str(i): row["auc"] for i, row in enumerate(found)})
    assert all(np.isnan(p.p_value) and np.isnan(p.adjusted) for p in pairs)
    assert all(p.estimate.low < p.estimate.value < p.estimate.high for p in pairs)
    of_nbt = {
        (p.first, p.second): p.adjusted for p in contrasts({str(i): r["nbt"] for i, r in enumerate(found)})
    }
    assert of_nbt.pop(("2", "3")) == 1 and np.isnan(list(of_nbt.values())).all()


def test_a_method_with_one_seed_has_the_spread_of_the_others(simulation):
    """One against five seeds: with no spread of its own, a quarter of equal pairs would differ significantly."""
    model, _ = simulation
    design, rng, false = model.Design(5, 10, 5), np.random.default_rng(12), 0
    for _ in range(60):
        one, five = (
            model.samples_of(o, design)["auc"] for o in model.simulate([model.Method()] * 2, design, rng)
        )
        (pair,) = contrasts({"one": one.of((0,)), "five": five})
        false += pair.adjusted < 0.05
    assert false <= 8, "3 are expected"


def test_one_method_whose_seeds_differ_more_does_not_make_many_false_differences():
    """Four times the spread of five others: 9 % of comparisons if pooling could make it smaller."""
    rng, false = np.random.default_rng(13), 0
    nothing = [np.zeros((2, 4)), np.zeros(4, np.int64), np.full(2, 1e-9)]
    for _ in range(200):
        drawn = {
            str(i): Sample((1, 2), rng.normal(0.5, 0.02 * (1 + 3 * (i == 0)), 2), *nothing) for i in range(6)
        }
        false += any(p.adjusted < 0.05 for p in contrasts(drawn))
    assert false <= 15, "10 are expected"


def test_orders_are_what_varies_where_there_are_several():
    rng = np.random.default_rng(8)
    orders = [tuple(f"task {i}" for i in rng.permutation(5)) for _ in range(3)]
    members = [Member(run(rng), seed, order) for order in orders for seed in (1, 2)]
    found = samples({"er": members})["final_success"]["er"]
    assert found.units == tuple(orders)
    by_order = [np.mean([m.scores.matrix[-1].mean() for m in members if m.order == o]) for o in orders]
    assert found.values == pytest.approx(by_order)


def test_pairs_that_do_not_differ_are_named_with_the_seeds_needed():
    rng = np.random.default_rng(10)
    groups = {
        name: [Member(run(rng, level=level), seed) for seed in (1, 2, 3)]
        for name, level in (("good", 0.9), ("alike", 0.87), ("poor", 0.1))
    }
    found = statistics(groups)
    (text,) = findings(found, {"final_success": "Final"})
    assert text.startswith("Final: 2 of 3 pairs differ significantly. Not: good and alike (")
    assert "seeds needed" in text
    assert findings(json.loads(json.dumps(found)), {"final_success": "Final"}) == [text]
    single = statistics({name: members[:1] for name, members in groups.items()})
    (text,) = findings(single, {"auc": "AUC"})
    assert text.startswith("AUC: 0 of 3 pairs differ significantly. None is tested: there is one seed")
    assert findings(json.loads(json.dumps(json_safe(single))), {"auc": "AUC"}) == [text]
    for row in found["metrics"].values():
        for name, metric in row.items():
            low, high = METRIC_RANGES[name]
            assert low <= metric["low"] <= metric["mean"] <= metric["high"] <= high


def test_undefined_metrics_stay_undefined():
    scores = run(np.random.default_rng(10))
    nothing = Curve(np.zeros(0, int), np.zeros(0), np.zeros(0, int))
    cut = dataclasses.replace(scores, curves=(*scores.curves[:-1], nothing))
    found = samples({"er": [Member(cut, 1), Member(cut, 2)]})
    for name in ("fwt", "auc"):
        assert np.isnan(interval(found[name]["er"], (0.0, 1.0)).low)
        assert contrasts(found[name]) == []
    assert np.isfinite(interval(found["nbt"]["er"], (-1.0, 1.0)).low)
