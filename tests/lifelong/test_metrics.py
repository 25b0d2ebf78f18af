"""The measures of eq. 3 against numbers worked out by hand, and properties of the intervals."""

import dataclasses

import numpy as np
import pytest

from lifelong.stats.intervals import difference_of, mean_and_standard_error, mean_success, wilson_interval
from lifelong.stats.metrics import (
    Curve,
    Scores,
    area_under_curve,
    average_success,
    estimate_cells,
    intransigence,
    lifelong_metrics,
    negative_backward_transfer,
    other_conventions,
)

NAN = float("nan")


def curve(*rates: float, episodes: int = 10) -> Curve:
    n = len(rates)
    return Curve(np.arange(n) * 5, np.array(rates, dtype=float), np.full(n, episodes))


def worked_example() -> Scores:
    curves = (curve(0.0, 0.8, 0.6), curve(0.2, 0.4, 0.4), curve(0.0, 0.0, 0.6))
    matrix = np.array([[0.8, NAN, NAN], [0.5, 0.4, NAN], [0.1, 0.3, 0.6]])
    return Scores(curves, matrix, np.tril(np.full((3, 3), 10)))


def test_success_counts_tasks_where_groups_are_learned_together():
    """A base of six tasks at 100 %, and four more at 0: six tenths of all, not a fifth."""
    matrix = np.where(np.tri(5, dtype=bool), [1.0, 0, 0, 0, 0], NAN)
    scores = Scores((curve(1.0),) * 5, matrix, np.tril(np.full((5, 5), 10)), group_sizes=(6, 1, 1, 1, 1))
    found = lifelong_metrics(scores)
    assert found.final_success.value == found.just_learned.value == pytest.approx(0.6)


def test_other_conventions_of_a_published_matrix():
    """RoboCasa365 (ICLR 2026), success after each of four phases [%], worked out by hand."""
    c = np.full((4, 4), NAN)
    c[np.tril_indices(4)] = [41.5, 13.9, 24.5, 13.9, 4.8, 11.3, 10.6, 1.7, 2.7, 4.3]
    found = other_conventions(c)
    first = (27.6 + 27.6 + 30.9) / 3, (19.7 + 22.8) / 2, 8.6  # what phases 1 to 3 lose
    assert found["bwt"] == pytest.approx(-(30.9 + 22.8 + 8.6) / 3)
    assert found["forgetting"] == pytest.approx((30.9 + 22.8 + 8.6) / 3)
    assert found["nbt_of_followed"] == pytest.approx(sum(first) / 3)
    assert found["nbt_of_followed"] == pytest.approx(negative_backward_transfer(c).mean() * 4 / 3)
    shares = [drop / learned for drop, learned in zip(first, (41.5, 24.5, 11.3), strict=True)]
    assert found["relative_nbt"] == pytest.approx(sum(shares) / 3)
    assert intransigence(c, [51.5, 24.5, 11.3, 4.3]) == pytest.approx(2.5)


def test_forgetting_counts_from_the_best_and_tasks_never_learned_have_no_share():
    c = np.array([[0.2, NAN, NAN], [0.6, 0.0, NAN], [0.1, 0.0, 0.5]])
    found = other_conventions(c)
    assert found["forgetting"] == pytest.approx((0.5 + 0.0) / 2)  # of task 1 from 0.6, its best
    assert found["bwt"] == pytest.approx(-0.05)
    assert found["relative_nbt"] == pytest.approx((0.2 - 0.35) / 0.2)  # of task 1 alone
    assert all(np.isnan(v) for v in other_conventions([[0.5]]).values())
    thinned = np.array([[0.2, NAN, NAN], [NAN, 0.4, NAN], [0.1, 0.3, 0.5]])
    assert np.isnan(other_conventions(thinned)["forgetting"]) and np.isfinite(
        other_conventions(thinned)["bwt"]
    )


def test_sampled_cells_give_unbiased_forgetting():
    """The mean over all samples that may be drawn, one cell of each row, is the metric of the whole matrix."""
    rng = np.random.default_rng(0)
    c = np.where(np.tri(5, dtype=bool), rng.random((5, 5)), NAN)
    fwt, rows, found = rng.random(5), [(k, k) for k in range(5)], []
    for kept in np.ndindex(1, 2, 3):
        sampled = c.copy()
        for row, one in zip((1, 2, 3), kept, strict=True):
            sampled[row, :row] = np.where(np.arange(row) == one, c[row, :row], NAN)
        cells = estimate_cells(sampled, rows)
        found.append([*negative_backward_transfer(cells), *area_under_curve(fwt, cells)])
    whole = [*negative_backward_transfer(c), *area_under_curve(fwt, c)]
    assert np.mean(found, axis=0) == pytest.approx(whole)
    assert np.array(found).std(0).max() > 0.05
    unfinished = estimate_cells(np.where(np.arange(5)[:, None] < 4, sampled, NAN), rows)
    assert np.isnan(negative_backward_transfer(unfinished)).any()
    together = np.where(
        np.arange(5)[:, None] < 1, NAN, sampled
    )  # tasks 0 and 1, in one stage that ends in row 1
    together[1, :2] = 0.25, 0.75
    assert np.isfinite(estimate_cells(together, [(1, 0), *rows[2:]])[1:][np.tril_indices(4, k=1, m=5)]).all()


def test_best_epoch_is_the_earliest_of_equals_and_holding_changes_nothing_else():
    c = curve(0.1, 0.5, 0.2, 0.5)
    assert c.best == 1
    assert c.held().tolist() == [0.1, 0.5, 0.5, 0.5]
    assert c.rates.tolist() == [0.1, 0.5, 0.2, 0.5]


def test_success_rates_of_a_run_have_wilsons_interval_and_other_metrics_none():
    found = lifelong_metrics(worked_example())
    assert average_success(worked_example().matrix) == pytest.approx([0.8, 0.45, 1 / 3])
    low, high = wilson_interval(10, 30)
    assert (found.final_success.low, found.final_success.high) == pytest.approx((float(low), float(high)))
    assert found.just_learned.low < 0.6 < found.just_learned.high
    assert all(np.isnan(getattr(found, name).low) for name in ("fwt", "nbt", "auc"))


def test_wilsons_interval_ends_at_0_and_1_and_takes_five_episodes():
    assert wilson_interval(0, 20)[0] == 0 and wilson_interval(20, 20)[1] == 1
    assert np.isnan(wilson_interval(2, 4)).all() and np.isfinite(wilson_interval(2, 5)).all()


def test_the_difference_of_two_rates_is_newcombes():
    # Newcombe (1998), difference of 56/70 and 48/80, method 10: 0.0524 to 0.3339.
    rates = mean_success([30, 26], [35, 35]), mean_success([48], [80])
    for share in (1.0, 0.5):
        found = difference_of(*rates, share)
        expected = share * np.array([0.2, 0.0524, 0.3339])
        assert (found.value, found.low, found.high) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize("starts", [2, 5, 20, 50])
@pytest.mark.parametrize(
    "rates", [np.full(10, 0.95), np.full(10, 0.5), np.linspace(0.8, 1, 10), np.linspace(0, 1, 10)]
)
def test_the_interval_of_a_mean_over_tasks_is_that_of_all_episodes_and_covers_it(rates, starts):
    rng, episodes = np.random.default_rng(0), np.full(10, starts)
    found = [mean_success(rng.binomial(episodes, rates), episodes) for _ in range(1000)]
    covered = [e.low <= rates.mean() <= e.high and 0 <= e.low <= e.value <= e.high <= 1 for e in found]
    assert np.mean(covered) > 0.91, "nearly 95 %: what single tasks' intervals make together covers 87 %"
    low, high = wilson_interval(round(found[0].value * 10 * starts), 10 * starts)
    assert (found[0].low, found[0].high) == pytest.approx((float(low), float(high)))


def test_tasks_count_alike_whatever_the_number_of_their_episodes():
    found = mean_success([10, 0], [10, 40])
    low, high = wilson_interval(16, 32)  # 4 / (1/10 + 1/40) episodes
    assert (found.value, found.low, found.high) == pytest.approx((0.5, float(low), float(high)))
    assert np.isnan(mean_success([], []).value) and np.isnan(mean_success([0], [0]).value)


def test_a_task_without_a_learning_curve_leaves_the_rest_defined():
    scores = worked_example()
    scores = dataclasses.replace(scores, curves=(*scores.curves[:2], curve()))
    found = lifelong_metrics(scores)
    assert np.isnan(found.fwt.value) and np.isnan(found.auc.value)
    assert found.nbt.value == pytest.approx(0.2)


def test_standard_error_over_seeds():
    assert mean_and_standard_error([0.2, 0.4, 0.6]) == pytest.approx((0.4, 0.2 / np.sqrt(3)))
    mean, error = mean_and_standard_error([0.3])
    assert mean == 0.3 and np.isnan(error)
    assert np.isnan(mean_and_standard_error([])[0])


def test_mismatched_scores_are_refused():
    with pytest.raises(ValueError, match="scores of 1 tasks"):
        Scores((curve(0.5),), np.zeros((2, 2)), np.zeros((2, 2), dtype=int))


def test_a_chosen_maximum_is_held_without_its_luck():
    """A curve that is 70 % from its second point on: eq. 3 as written is 8 points too high with five episodes."""
    rng, truth = np.random.default_rng(3), np.array([0.0, 0.7, 0.7, 0.7, 0.7, 0.7])
    found: dict[str, list[float]] = {"published": [], "cross_fitted": [], "plain": [], "kept": []}
    for _ in range(1500):
        won = (rng.random((6, 5)) < truth[:, None]).astype(float)
        c = Curve(np.arange(6), won.mean(1), np.full(6, 5), won[..., None])
        for kind in ("published", "cross_fitted", "plain"):
            found[kind].append(c.transfer(kind))
        found["kept"].append(truth[c.best] * (6 - c.best) / 6 + truth[: c.best].sum() / 6)
    bias = {kind: np.mean(values) - np.mean(found["kept"]) for kind, values in found.items()}
    assert bias["published"] > 0.05 and abs(bias["cross_fitted"]) < 0.02
    assert np.mean(found["plain"]) == pytest.approx(truth.mean(), abs=0.02)
