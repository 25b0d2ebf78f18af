"""Methods compared over seeds: against libraries, textbooks and numbers worked out by hand."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats import contingency_tables, power, proportion, weightstats
from statsmodels.stats.multitest import multipletests

from libero_env.text import json_safe
from libero_eval.stats.episodes import Counts, mcnemar_exact
from lifelong.report.comparison import findings
from lifelong.stats.intervals import holm, wilson_interval
from lifelong.stats.methods import (
    MethodRun,
    mean_over_seeds,
    paired_difference,
    seeds_needed,
    statistics,
    welch_difference,
)
from lifelong.stats.metrics import Curve, Scores


def run(seed: int, final: float, order: str = "a") -> MethodRun:
    """A run of two tasks: 90 % just learned, and at the end a success of `final` on the first of them."""
    curves = (Curve(np.arange(2), np.array([0.5, 0.9]), np.full(2, 5)),) * 2
    matrix = np.array([[0.9, np.nan], [final, 0.9]])
    return MethodRun(Scores(curves, matrix, np.array([[20, 0], [20, 20]]), transfer="plain"), seed, order)


def method(*finals: float, first: int = 1) -> list[MethodRun]:
    return [run(seed, final) for seed, final in enumerate(finals, first)]


def test_the_number_of_seeds_is_that_of_the_noncentral_t_distribution():
    for effect, level in [(0.5, 0.05), (1.2, 0.05), (2.0, 0.01)]:
        expected = power.TTestPower().solve_power(effect, alpha=level, power=0.8)
        assert seeds_needed(-2 * effect, 2.0, level) == np.ceil(expected)
    assert seeds_needed(0.01, 1.0) is None and seeds_needed(0.0, 1.0) is None
    assert seeds_needed(5.0, 0.1) == 3, "no fewer than a test takes"


def test_holm_against_a_published_example():
    """R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm"); what was not tested does not count."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    adjusted = holm([0.01, np.nan, 0.04])
    assert adjusted[::2] == pytest.approx([0.02, 0.04]) and np.isnan(adjusted[1])


def test_the_interval_of_a_mean_contains_wilsons():
    values = np.array([0.91, 0.95, 0.93, 0.90, 0.96])
    found = mean_over_seeds(values, 10**6, (0.0, 1.0))
    assert (found.low, found.high) == pytest.approx(
        stats.t.interval(0.95, 4, values.mean(), stats.sem(values))
    )
    certain = mean_over_seeds(np.ones(5), 100, (0.0, 1.0))
    assert (certain.low, certain.high) == (pytest.approx(float(wilson_interval(100, 100)[0])), 1.0)
    assert mean_over_seeds(np.zeros(3), 100, (-1.0, 1.0)).high == 0, "nothing is forgotten"
    assert np.isnan(mean_over_seeds(np.full(3, 0.2), 100, (-1.0, 1.0)).low), "equal by chance"


def test_each_method_is_compared_with_the_references_and_no_others():
    methods = {"er": method(0.8, 0.7, 0.9), "ewc": method(0.2, 0.3, 0.1), "si": method(0.3, 0.1, 0.2)}
    found = statistics(methods, ["er"])
    assert [(d["of"], d["less"]) for d in found["differences"]] == [("ewc", "er"), ("si", "er")]
    final = found["differences"][0]["metrics"]["final_success"]
    assert final["by_seed"] == pytest.approx([-0.3, -0.2, -0.4])
    assert final["p_value"] == pytest.approx(stats.ttest_1samp([-0.3, -0.2, -0.4], 0).pvalue)
    other = found["differences"][1]["metrics"]["final_success"]  # the smaller p-value of the two
    assert other["adjusted"] == pytest.approx(2 * other["p_value"]) and final["adjusted"] == final["p_value"]
    assert len(statistics(methods, ["er", "si"])["differences"]) == 3
    assert len(statistics(methods, all_pairs=True)["differences"]) == 3
    assert statistics(methods)["differences"] == []
    assert "--reference" in findings(statistics(methods), {"auc": "AUC"})[0]
    with pytest.raises(ValueError, match="'lwf' is not a method; there are er, ewc, si"):
        statistics(methods, ["lwf"])
    with pytest.raises(ValueError, match="--all-pairs and --reference er si name different pairs"):
        statistics(methods, ["er", "si"], all_pairs=True)


def test_other_methods_in_the_table_do_not_change_what_two_differ_in():
    pair = {"er": method(0.8, 0.7, 0.9), "ewc": method(0.7, 0.72, 0.8)}
    wild = {"clare": method(0.0, 0.5, 0.9)}
    few, many = (statistics(m, ["er"])["differences"][0]["metrics"]["auc"] for m in (pair, pair | wild))
    for name in ("value", "low", "high", "p_value", "equivalence"):
        assert few[name] == many[name]


def test_two_seeds_are_not_tested_and_those_of_unpaired_methods_are():
    def differences(a: list[MethodRun], b: list[MethodRun]) -> dict:
        return json_safe(statistics({"a": a, "b": b})["differences"][0]["metrics"])

    two = differences(method(0.8, 0.7), method(0.2, 0.4))["final_success"]
    assert two["p_value"] is None and not two["significant"] and two["low"] < two["value"] < two["high"]
    one = differences(method(0.8), method(0.2))["final_success"]
    assert one["p_value"] is None and one["low"] is None and one["value"] == pytest.approx(0.3)
    apart = differences(method(0.8, 0.7, 0.9), method(0.2, 0.4, 0.3, first=4))["final_success"]
    expected = stats.ttest_ind([0.85, 0.8, 0.9], [0.55, 0.65, 0.6], equal_var=False)
    assert apart["p_value"] == pytest.approx(expected.pvalue) and apart["by_seed"] == []
    same = differences(method(0.8, 0.7, 0.9), method(0.3, 0.2, 0.4))["final_success"]
    assert same["p_value"] is None and same["value"] == pytest.approx(0.25), "no spread to test against"


def test_equivalence_is_shown_or_left_open():
    a, close, far = ([0.80, 0.70, 0.90], [0.81, 0.70, 0.895], [0.7, 0.9, 0.8])
    found = statistics({"a": method(*a), "close": method(*close), "far": method(*far)}, ["a"], margin=0.05)
    close, far = (d["metrics"]["final_success"] for d in found["differences"])
    assert close["equivalent"] and not close["significant"]
    assert not far["equivalent"] and not far["significant"]
    (line,) = findings(found, {"final_success": "Final"})
    assert "Equivalent within ±5 points: close − a." in line and "Open: far − a" in line
    with pytest.raises(ValueError, match="margin"):
        statistics({"a": method(*a)}, margin=0.0)


def test_where_orders_vary_they_are_what_is_drawn():
    """Runs of one order with several seeds are one observation, their mean."""
    runs = [run(seed, final, order) for seed, order, final in [(1, "a", 0.2), (2, "a", 0.4), (1, "b", 0.6)]]
    found = statistics({"er": runs})["metrics"]["er"]["final_success"]
    assert found["values"] == pytest.approx([(0.55 + 0.65) / 2, 0.75])


def test_published_forward_transfer_does_not_mix_with_others():
    won = np.array([[0, 1, 1, 1], [1, 1, 0, 1], [1, 0, 1, 1]], float)[..., None]
    curve = Curve(np.arange(3), won.mean((1, 2)), np.full(3, 4), won)
    scores = [
        Scores((curve,), np.array([[0.75]]), np.array([[4]]), transfer=t)
        for t in ("published", "cross_fitted")
    ]
    apart = [statistics({"a": [MethodRun(s, 1)]})["metrics"]["a"]["fwt"]["mean"] for s in scores]
    mixed = statistics({"a": [MethodRun(scores[0], 1)], "b": [MethodRun(scores[1], 1)]})["metrics"]
    assert apart[0] != apart[1] and mixed["a"]["fwt"]["mean"] == mixed["b"]["fwt"]["mean"] == apart[1]


@pytest.mark.parametrize("seed", range(5))
def test_intervals_and_tests_are_those_of_statsmodels(seed):
    """Wilson's interval, Holm's adjustment, McNemar's exact test, Student's and Welch's t, two one-sided tests."""
    rng, margin = np.random.default_rng(seed), 0.1
    n = rng.integers(5, 300, 40)
    s = rng.binomial(n, rng.random(40))
    for ends, theirs in zip(
        wilson_interval(s, n), proportion.proportion_confint(s, n, method="wilson"), strict=True
    ):
        np.testing.assert_allclose(ends, theirs, atol=1e-12)
    p = rng.random(12) ** 3
    np.testing.assert_allclose(holm(p), multipletests(p, method="holm")[1])
    counts = Counts(*map(int, rng.integers(0, 20, 4)))
    table = [[counts.both, counts.only_first], [counts.only_second, counts.neither]]
    assert mcnemar_exact(counts) == pytest.approx(contingency_tables.mcnemar(table, exact=True).pvalue)
    first, second = rng.normal(0.6, 0.1, 6), rng.normal(0.55, 0.2, 5)
    gaps = weightstats.DescrStatsW(first[:5] - second)
    found = paired_difference(first[:5] - second, margin)
    assert found.p_value == pytest.approx(gaps.ttest_mean(0)[1])
    assert found.equivalence == pytest.approx(gaps.ttost_mean(-margin, margin)[0])
    assert (found.estimate.low, found.estimate.high) == pytest.approx(gaps.tconfint_mean(0.05))
    both = weightstats.CompareMeans(weightstats.DescrStatsW(first), weightstats.DescrStatsW(second))
    found = welch_difference(first, second, margin)
    assert found.p_value == pytest.approx(both.ttest_ind(usevar="unequal")[1])
    assert found.equivalence == pytest.approx(both.ttost_ind(-margin, margin, usevar="unequal")[0])
    assert (found.estimate.low, found.estimate.high) == pytest.approx(
        both.tconfint_diff(0.05, usevar="unequal")
    )
