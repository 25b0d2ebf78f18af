"""Causes of failed episodes and costs of all in results, on whatever they are run, and in what people read."""

from dataclasses import replace

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.sim.causes import Failure
from libero_env.sim.costs import Costs
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.judging.comparability import Group
from libero_eval.judging.comparison import compare_groups
from libero_eval.judging.evaluation_page import write_evaluation_page
from libero_eval.judging.page import render, write_page
from libero_eval.work.progress import total_rows
from lifelong.evaluation.rollout import run_episodes
from tests.harness.results import drawn_result, result_of, task_result

HIT = Failure("collided", "bowl_1", "table", 123.4)
AWAY = Failure("never reached", "bowl_1", handled=("cheese_1",), instead=("(On cheese_1 plate_1)",))


class Down:
    """Press the hand down."""

    action_dim, views = 7, ()

    def reset(self, num_envs):
        self.num = num_envs

    def act(self, obs):
        return np.tile([0.0, 0.4, -1.0, 0.0, 0.0, 0.0, 1.0], (self.num, 1))


def test_causes_are_the_same_in_any_batch():
    def run(starts):
        with BatchEnv("libero_goal/6", len(starts), cameras=(), horizon=45, num_threads=1) as env:
            return run_episodes(Down(), env, starts, horizon=40).episodes

    together = run([0, 1])
    assert together == run([0]) + run([1])
    assert [one.failure.cause for one in together] == ["collided", "collided"], together


def with_failures(result, failure):
    tasks = [
        replace(t, failures=tuple(None if won else failure for won in t.successes)) for t in result.tasks
    ]
    return replace(result, tasks=tuple(tasks))


def test_results_keep_causes_and_their_digest_is_that_without(tmp_path):
    plain = drawn_result(0.7, 1)
    result = with_failures(plain, AWAY)
    result.write(tmp_path / "eval.json")
    assert EvaluationResult.read(tmp_path) == result and result.outcomes == plain.outcomes
    lost = sum(not won for task in result.tasks for won in task.successes)
    assert total_rows(result)[-1] == f"failed because     never reached {lost}"
    assert "failed because" not in total_rows(plain)[-1]


def test_comparisons_show_the_causes_of_each_policy(tmp_path):
    policies = [
        Group("good", (with_failures(drawn_result(0.9, 1), HIT),), ("a",)),
        Group("bad", (with_failures(drawn_result(0.7, 2, policy="other:make"), AWAY),), ("b",)),
    ]
    found = compare_groups(policies)
    assert list(found.rates[0].causes) == ["collided"] and list(found.rates[1].causes) == ["never reached"]
    rows = [line.split() for line in render(found).splitlines()]
    assert ["failed", "because", "collided", "never", "reached"] in rows
    assert ["bad", "0", str(found.rates[1].causes["never reached"])] in rows
    page = write_page(found, tmp_path / "page.html").read_text()
    assert "Why episodes failed" in page and "Never reached" in page


def with_costs(result, *costs):
    """Return a result whose episodes have these costs, in turn."""
    tasks = [replace(t, costs=tuple(costs[i % len(costs)] for i in t.init_states)) for t in result.tasks]
    return replace(result, tasks=tuple(tasks))


SPILT = Costs(shift=0.3, tilt=90.0, moved=("bottle_1",))


def test_results_keep_costs_and_say_how_many_episodes_were_safe_and_successful(tmp_path):
    plain = result_of(task_result("libero_goal/0", [True, True, False, False]))
    result = with_costs(plain, Costs(), SPILT)
    result.write(tmp_path / "eval.json")
    assert EvaluationResult.read(tmp_path) == result and result.outcomes == plain.outcomes
    safety = "safe success 1, unsafe success 1, safe failure 1, unsafe failure 1 (unsafe by shift 2, tilt 2)"
    assert total_rows(result)[-1] == f"costs              {safety}"
    assert safety in write_evaluation_page(result, tmp_path).read_text()
    unseen = with_costs(plain, None)
    assert total_rows(unseen) == total_rows(plain), "nothing is said where no costs were seen"


def test_comparisons_show_how_many_episodes_of_each_policy_were_safe(tmp_path):
    plain = result_of(task_result("libero_goal/0", [True, False]))
    other = result_of(task_result("libero_goal/0", [True, True]), policy="other:make")
    groups = [
        Group("good", (with_costs(plain, Costs()),), ("a",)),
        Group("bad", (with_costs(other, SPILT),), ("b",)),
    ]
    found = compare_groups(groups)
    rows = [line.split() for line in render(found).splitlines()]
    assert ["safety", "safe", "success", "unsafe", "success", "safe", "failure", "unsafe", "failure"] in rows
    assert ["good", "1", "0", "1", "0"] in rows and ["bad", "0", "2", "0", "0"] in rows
    page = write_page(found, tmp_path / "page.html").read_text()
    assert "<h2>Safety</h2>" in page and "Unsafe success" in page and "Why episodes failed" not in page
