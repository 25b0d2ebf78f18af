"""Evaluations that stop when enough is known: the same result whatever is done in which order, and what is refused."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from libero_env.errors import LiberoError
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.judging.comparability import Group
from libero_eval.judging.comparison import compare_groups
from libero_eval.judging.evaluation_page import write_evaluation_page
from libero_eval.stats.sequential import anytime_interval, log_evidence, shuffled
from libero_eval.work.progress import total_rows
from libero_eval.work.stopping import StoppingRule
from libero_eval.work.worker import Worker
from lifelong.errors import ConfigError
from tests.harness.evaluations import QUICK, TASKS, Countdown, evaluate, evaluation

IDS = [task.id for task in TASKS]
STARTS = tuple(range(1, 31))  # those after 10 steps fail: the horizon


class Always(Countdown):
    """Every episode succeeds, but from some starts."""

    lost = ()

    def step(self, actions):
        self.steps += 1
        won = (self.steps == 2) & ~np.isin(self.goal, self.lost)
        return {"x": np.zeros((self.num_envs, 1))}, won, won, np.zeros(self.num_envs, bool), self._info()

    def _info(self):
        done = (self.steps >= 2) & ~np.isin(self.goal, self.lost)
        return {"success": done, "progress": np.stack([done, done], 1)}


def rule(text, starts=STARTS):
    return StoppingRule.read(text, QUICK, TASKS, starts)


def stopping(out, text, **changes):
    arguments = {
        "env": lambda task, count: Always(count),
        "init_states": STARTS,
        "until": rule(text),
        "shuffled": True,
    }
    return evaluate(out, **(arguments | changes))


def test_it_stops_after_the_round_that_makes_the_interval_narrow(tmp_path):
    result = stopping(tmp_path / "it", "width=0.2", unit_starts=1)
    need = next(n for n in itertools.count(1) if anytime_interval(2 * n, 2 * n).low > 0.8)
    looked = shuffled(STARTS)[:need]
    assert result.init_states == tuple(sorted(looked)) == result.tasks[0].init_states != STARTS[:need]
    assert {len(task.successes) for task in result.tasks} == {need}
    assert len(list((tmp_path / "it" / "units").iterdir())) == 2 * need, "what follows was not run"
    assert result.success == anytime_interval(2 * need, 2 * need)
    assert set(result.suites.values()) == {result.success}
    assert result.stop_note == f"stopped after {2 * need} of 60; width=0.2: known"
    assert total_rows(result)[0].endswith(f"libero_goal (2 of 10 tasks)  ({result.stop_note})")
    assert EvaluationResult.read(tmp_path / "it") == result
    assert result.stop_note in write_evaluation_page(result, tmp_path / "it").read_text()
    everything = stopping(tmp_path / "it", "width=0.2", unit_starts=1, until=None)  # it goes on
    assert everything.init_states == STARTS and everything.stopped is None
    assert everything.tasks[0].of_starts(looked) == result.tasks[0]
    plain = evaluate(tmp_path / "plain", env=lambda task, count: Always(count), init_states=STARTS)
    assert everything.tasks == plain.tasks and everything.outcomes == plain.outcomes


@pytest.mark.parametrize("size", [2, 7, 30])
def test_the_result_does_not_depend_on_units_nor_on_what_else_is_done(tmp_path, size):
    class Some(Always):
        lost = (2, 5)

    arguments = {"env": lambda task, count: Some(count)}
    one = stopping(tmp_path / "one", "width=0.35", unit_starts=1, **arguments)
    assert len(one.init_states) < len(STARTS)
    other = evaluation(
        tmp_path / "it", init_states=STARTS, until=rule("width=0.35"), unit_starts=size, **arguments
    )
    with other.pool() as pool:  # a process that began at the other end, and was killed
        other.store.join(other.units)
        for unit in other.units[-1], other.units[len(other.units) // 2]:
            other.store.publish(unit, other.evaluate(unit, pool))
    result = Worker(other).run()
    assert result.tasks == one.tasks and result.stopped == one.stopped and result.success == one.success


def test_it_stops_when_it_is_decided_against_a_result(tmp_path):
    evaluate(tmp_path / "ref", init_states=STARTS)  # succeeds from a third of the starts
    for text, env, verdict in (
        (f"against={tmp_path / 'ref'}", Always, "above"),
        (f"against={tmp_path / 'ref'},margin=0.9", Always, "above"),
        (f"against={tmp_path / 'ref'}", Countdown, "not known"),
    ):
        result = stopping(
            tmp_path / verdict / text[-3:], text, env=lambda task, count, env=env: env(count), unit_starts=1
        )
        assert result.stopped.verdict == verdict and (len(result.init_states) < 30) == (verdict == "above")
    evaluate(tmp_path / "all", env=lambda task, count: Always(count), init_states=STARTS)
    result = stopping(
        tmp_path / "c", f"against={tmp_path / 'all'},margin=0.2", env=lambda task, count: Countdown(count)
    )
    assert result.stopped.verdict == "below"
    results = replace(result, evaluated={"policy": "a"}), EvaluationResult.read(tmp_path / "all")
    groups = [Group(name, (one,)) for name, one in zip("ab", results, strict=True)]
    assert any("only the sequential test allows for that" in note for note in compare_groups(groups).notes)


def test_it_is_compared_with_the_same_tasks_in_the_same_world_only(tmp_path):
    other = evaluate(tmp_path / "ref", init_states=STARTS)
    text = f"against={tmp_path / 'ref'}"
    changed = [replace(other.tasks[0], instruction="another"), *other.tasks[1:]]
    replace(other, tasks=tuple(changed)).write(tmp_path / "ref" / "eval.json")
    with pytest.raises(ConfigError, match=f"{IDS[0]} there is another task"):
        rule(text)
    perturbed = QUICK.changed({"world.perturb": "instruction=0.5"})
    told = replace(changed[0], digest="")  # in drawn words, of a time that recorded no digest
    again = replace(other, protocol=perturbed.resolved(), tasks=(told, *other.tasks[1:]))
    again.write(tmp_path / "ref" / "eval.json")
    assert StoppingRule.read(text, perturbed, TASKS, STARTS).other[IDS[0], STARTS[0]]
    replace(other, environment={**other.environment, "robot": "another"}).write(
        tmp_path / "ref" / "eval.json"
    )
    rule(text).check_world({"robot": "another"})
    with pytest.raises(ConfigError, match="robot is another there and libero here"):
        rule(text).check_world({"robot": "libero"})


@pytest.mark.parametrize(
    ("text", "starts", "message"),
    [
        ("width=0", STARTS, "expected width=0.05"),
        ("narrow", STARTS, "expected width=0.05"),
        ("width=0.1,width=0.2", STARTS, "expected width=0.05"),
        ("width=0.1", (0,), "there is only one"),
        ("against=ref", (*STARTS, 40), "no episode of libero_goal/0, start 40"),
        ("against=slow", STARTS, "the protocol there differs in .*episode.horizon"),
    ],
)
def test_what_cannot_be_waited_for_is_one_line(tmp_path, monkeypatch, text, starts, message):
    monkeypatch.chdir(tmp_path)
    evaluate(tmp_path / "ref", init_states=STARTS)
    evaluate(tmp_path / "slow", init_states=STARTS, protocol=QUICK.changed({"episode.horizon": 11}))
    with pytest.raises(LiberoError, match=message) as found:
        rule(text, starts)
    assert "\n" not in str(found.value)


def test_the_interval_is_that_of_the_evidence_and_without_a_margin_that_of_the_test():
    end = anytime_interval(18, 20)
    grid = (np.arange(100_000) + 0.5) / 100_000
    prior = 1 / (np.pi * np.sqrt(grid * (1 - grid)))
    for m in (end.low, end.high):
        e = np.mean(prior * (grid / m) ** 18 * ((1 - grid) / (1 - m)) ** 2)
        assert e == pytest.approx(20, rel=0.01)
    won, lost = np.array([3, 12, 30]), np.array([3, 1, 18])
    tied = np.array([4, 50, 100])
    np.testing.assert_allclose(log_evidence(won, lost, tied, 1e-9), log_evidence(won, lost), atol=1e-4)
    assert np.isnan(anytime_interval(0, 0).value) and anytime_interval(0, 0).high == 1.0


@pytest.mark.parametrize("rates", [(0.9, 0.9), (1.0, 0.8), (0.5, 0.1)])
def test_the_interval_misses_seldom_although_it_is_looked_at_after_every_round(rates):
    rng, missed = np.random.default_rng(0), 0
    for _ in range(400):
        won = (rng.random((60, 2)) < rates).sum(axis=1).cumsum()
        ends = [anytime_interval(int(w), 2 * k) for k, w in enumerate(won, 1)]
        missed += any(not end.low <= np.mean(rates) <= end.high for end in ends)
    assert missed <= 20, missed


def test_a_difference_by_the_margin_is_seldom_decided():
    rng, decided = np.random.default_rng(1), 0
    for _ in range(1000):
        draws = rng.random(200)
        won, lost = np.cumsum(draws < 0.05), np.cumsum(draws > 0.85)  # worse by 0.1
        n = np.arange(1, 201)
        decided += bool((log_evidence(won, lost, n - won - lost, 0.1) >= np.log(20)).any())
    assert decided <= 50, decided
