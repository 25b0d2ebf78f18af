"""Statistics of paired outcomes against libraries, published numbers and exact enumeration."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from libero_eval.judging.power_text import shown, table
from libero_eval.stats.episodes import (
    Counts,
    Pairs,
    bootstrap_starts,
    bootstrap_tasks,
    chance_difference,
    difference,
    mcnemar_exact,
    score_interval,
    sign_flip_test,
)
from libero_eval.stats.power import (
    Question,
    discordance_of,
    paired_episodes,
    paired_power,
    sequential_stopping,
    shown_difference,
    unpaired_episodes,
)
from libero_eval.stats.sequential import log_evidence, rounds, sequential_test
from lifelong.errors import ConfigError


def pairs(first, second, tasks: int = 1) -> Pairs:
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    each = len(first) // tasks
    columns = [x.reshape(len(x), -1) for x in (first, second)]
    return Pairs(np.repeat(np.arange(tasks), each), np.tile(np.arange(each), tasks), *columns)


@pytest.mark.parametrize(("cells", "confidence", "low", "high"), [
    ((1, 1, 7, 12), 0.95, -0.517, -0.026),  # Fagerland et al. 2014, airway hyper-responsiveness
    ((0, 28, 25, 565), 0.90, -0.0148, 0.0247),  # R, PropCIs::scoreci.mp(25, 28, 618, 0.90)
])  # fmt: skip
def test_tangos_interval_is_the_published_one(cells, confidence, low, high):
    found = score_interval(Counts(*cells), confidence)
    assert (found.low, found.high) == pytest.approx((low, high), abs=6e-4 if confidence == 0.95 else 6e-5)


def test_tangos_interval_has_a_width_where_nothing_differs_and_stays_inside():
    same = score_interval(Counts(468, 0, 0, 32))
    assert same.low == -same.high < 0 < same.high < 0.01
    assert score_interval(Counts(0, 5, 0, 0)).high == 1.0 > score_interval(Counts(0, 5, 0, 0)).low > 0
    assert score_interval(Counts(0, 0, 5, 0)).low == -1.0
    assert score_interval(Counts(5, 0, 0, 0)).high < 1 and math.isnan(score_interval(Counts(4, 0, 0, 0)).high)


def test_mcnemar_is_the_binomial_test_of_the_discordant_pairs():
    for b, c in [(5, 0), (9, 3), (20, 31), (0, 0)]:
        expected = stats.binomtest(b, b + c).pvalue if b + c else 1.0
        assert mcnemar_exact(Counts(10, b, c, 3)) == pytest.approx(expected)


def test_sign_flips_of_several_runs_are_exact_for_few_starts():
    moved = np.array([0.5, 1.0, -0.5, 0.5, 0.0])
    flips = [np.dot(signs, moved[:4]) for signs in itertools.product((1, -1), repeat=4)]
    expected = np.mean(np.abs(flips) >= abs(moved.sum()) - 1e-12)
    assert sign_flip_test(moved) == pytest.approx(expected)


def test_the_bootstrap_draws_starts_within_tasks():
    """Tasks that differ from each other, but not within, have no spread over starts and much over tasks."""
    found = pairs([1] * 15 + [0] * 15, [0] * 15 + [1] * 15, tasks=6)
    starts, tasks = bootstrap_starts(found, draws=200), bootstrap_tasks(found, draws=200)
    assert (starts.low, starts.high) == (0, 0)
    assert tasks is not None and tasks.low < -0.5 and tasks.high > 0.5
    assert bootstrap_tasks(pairs([1, 0], [0, 0])) is None


def test_the_bootstrap_is_repeatable_and_unknown_for_single_starts():
    rng = np.random.default_rng(0)
    found = pairs(rng.random(60) < 0.8, rng.random(60) < 0.5, tasks=3)
    assert bootstrap_starts(found, draws=300) == bootstrap_starts(found, draws=300)
    assert math.isnan(bootstrap_starts(pairs([1, 0], [0, 0], tasks=2)).low)


@pytest.mark.parametrize("value", [0, 1])
def test_all_successes_or_all_failures_are_no_difference(value):
    found = difference(pairs([value] * 20, [value] * 20, tasks=2), draws=200)
    assert found.value == 0 and found.p_value == 1 and found.by_chance == 0
    assert found.score is not None and found.score.low < 0 < found.score.high


def test_chance_makes_what_mcnemar_does_not_reject():
    counts = Counts(400, 20, 20, 60)
    limit = round(chance_difference(counts) * 500)  # lead, of 40 discordant pairs
    won = (40 + limit) // 2
    assert mcnemar_exact(Counts(400, won, 40 - won, 60)) > 0.05 / 2
    assert mcnemar_exact(Counts(400, won + 1, 39 - won, 60)) <= 0.05


def test_evidence_is_a_martingale_of_mean_one():
    """Exact: the mean of e over all sequences of n equally likely wins and losses."""
    for n in (1, 5, 30):
        won = np.arange(n + 1)
        assert stats.binom.pmf(won, n, 0.5) @ np.exp(log_evidence(won, n - won)) == pytest.approx(1)


def test_the_sequential_test_goes_round_all_tasks():
    found = pairs([1] * 12, [0] * 12, tasks=3)
    order = rounds(found)
    assert found.tasks[order].tolist() == [0, 1, 2] * 4
    assert found.starts[order].reshape(4, 3).tolist() == [[start] * 3 for start in (0, 2, 1, 3)]
    test = sequential_test(found)
    # e = 2^n / (n + 1) for n wins in a row: above 20 at n = 8
    assert test.decided_after == 8 and test.first_better is True
    assert test.p_value == pytest.approx(13 / 2**12)
    undecided = sequential_test(pairs([1, 0, 1], [1, 0, 1]))
    assert undecided.decided_after is None and undecided.first_better is None and undecided.p_value == 1


def test_power_is_that_of_simulated_evaluations():
    question, rng = Question(0.9, 0.05, 0.11), np.random.default_rng(1)
    cells = rng.multinomial(200, [0.08, 0.03, 0.89], size=20_000)
    kinds, repeats = np.unique(cells[:, :2], axis=0, return_counts=True)
    shown_by = [stats.binomtest(int(b), int(b + c)).pvalue <= 0.05 if b + c else False for b, c in kinds]
    assert paired_power(question, 200) == pytest.approx(np.average(shown_by, weights=repeats), abs=0.01)


def test_the_number_of_pairs_is_the_first_with_the_power():
    question = Question(0.9, 0.03, 0.1)
    count = paired_episodes(question)
    assert paired_power(question, count) >= 0.8 > paired_power(question, count - 1)
    assert paired_episodes(Question(0.9, 0.03, 0.1, tests=4)) > count
    assert paired_episodes(Question(0.9, 0.03, 0.05)) < count < paired_episodes(Question(0.9, 0.03))
    assert shown_difference(question, count, discordance=0.1) == pytest.approx(0.03, abs=0.001)


def test_episodes_in_other_starts_are_as_in_textbooks():
    """Two proportions with pooled variance: Fleiss, Levin & Paik (2003), eq. 4.14, without continuity correction."""
    z = stats.norm.ppf([0.975, 0.8])
    pooled, spread = math.sqrt(2 * 0.75 * 0.25), math.sqrt(0.8 * 0.2 + 0.7 * 0.3)
    expected = ((z[0] * pooled + z[1] * spread) / 0.1) ** 2
    assert unpaired_episodes(Question(0.7, 0.1)) == pytest.approx(expected, abs=1)
    assert unpaired_episodes(Question(0.8, -0.1)) == unpaired_episodes(Question(0.7, 0.1))


def test_correlated_outcomes_differ_less():
    assert discordance_of(0.9, 0.03, 0) == pytest.approx(0.9 * 0.07 + 0.93 * 0.1)
    assert discordance_of(0.9, 0.03, 0.5) < discordance_of(0.9, 0.03, 0.1)
    count = paired_episodes(Question(0.9, -0.1, discordance_of(0.9, -0.1, 0.5)))
    assert shown_difference(Question(0.9, -0.1), count, correlation=0.5) == pytest.approx(0.1, abs=0.002)
    assert f"worse by {100 * shown_difference(Question(0.9, -0.1), 50, correlation=0.5):.1f} p" in shown(
        Question(0.9, -0.1), 50, correlation=0.5
    )


def test_a_discordance_counts_as_far_as_each_difference_allows():
    """A third of the pairs cannot differ between 90 and 89.9 %, but can between 90 and 70 %."""
    found = shown_difference(Question(0.9, -0.1), 60, discordance=1 / 3)
    assert paired_power(Question(0.9, -found, 1 / 3), 60) >= 0.8
    assert paired_power(Question(0.9, 0.001 - found, min(1 / 3, 0.2 + found - 0.001)), 60) < 0.8
    assert found > shown_difference(Question(0.9, -0.1), 60, discordance=0.2)
    assert "worse by" in shown(Question(0.9, -0.1), 60, discordance=1 / 3)


def test_the_sequential_test_stops_earlier_for_larger_differences():
    small = sequential_stopping(Question(0.8, 0.05, 0.15), 2000, simulations=300)
    large = sequential_stopping(Question(0.8, 0.15, 0.2), 2000, simulations=300)
    assert large.median < small.median and large.power == 1.0


@pytest.mark.parametrize(("values", "message"), [
    ((0.9, 0.2), "between 0 and 1"),
    ((1.0, -0.1), "--base, .* is 1; it has to be"),
    ((0.9, 0.0), "cannot be shown"),
    ((0.9, 0.05, 0.01), "a discordance of 0.01 is impossible"),
    ((0.9, 0.05, None, 0.01), "alpha < power"),
])  # fmt: skip
def test_impossible_questions_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        Question(*values)


def test_a_difference_that_needs_millions_is_refused():
    with pytest.raises(ConfigError, match="more than 2,000,000"):
        paired_episodes(Question(0.5, 0.0005))


def test_tables_of_power_name_what_is_impossible():
    assert "–" in table(Question(0.9, 0.03)) and "success 99.5 %" in table(Question(0.995, 0.003))
    assert "worse by" in shown(Question(0.9, 0.03), 500)
    assert "no difference that is possible" in shown(Question(0.99, 0.005), 20)


def test_published_counts_under_events_pass_through_the_arithmetic_of_comparisons():
    """pi0.5 in LIBERO-MAX, of 8,000 pairs: successes without and with an event, and the share of the former lost."""
    base, dynamic, loss = 6374, 5259, 21.6
    lost = round(base * loss / 100)
    cells = (base - lost, lost, dynamic - (base - lost), 8000 - dynamic - lost)  # as in Counts
    first, second = (
        np.repeat(won, cells)[:, None] for won in ([True, True, False, False], [True, False, True, False])
    )
    found = difference(Pairs(np.zeros(8000, int), np.arange(8000), first, second), draws=0)
    assert found.counts == Counts(*cells) and round(100 * found.counts.lost, 1) == loss
    assert (round(8000 * found.first), round(8000 * found.second)) == (base, dynamic)
    assert found.value == pytest.approx((base - dynamic) / 8000) and found.p_value < 1e-50
    paired = (found.score.high - found.score.low) / (2 * 1.96)
    rates = np.array([base, dynamic]) / 8000
    unpaired = np.sqrt((rates * (1 - rates) / 8000).sum())
    assert (round(100 * paired, 2), round(100 * unpaired, 2)) == (0.48, 0.70)
