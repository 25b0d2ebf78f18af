"""Causes of failed episodes and costs of all in results, on whatever they are run, and in what people read."""

import json
from dataclasses import replace

import numpy as np
import pytest

from libero_env.envs.batch import BatchEnv
from libero_env.sim.causes import Failure
from libero_env.sim.costs import Costs
from libero_eval.evaluation_file import FILE_NAME, EvaluationFileError, EvaluationResult
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


def test_a_policy_whose_costs_and_causes_were_not_seen_is_not_shown_as_one_without(tmp_path):
    plain = result_of(task_result("libero_goal/0", [True, False, False]))
    other = result_of(task_result("libero_goal/0", [True, True, False]), policy="other:make")
    seen = with_failures(with_costs(plain, Costs()), HIT)
    found = compare_groups([Group("good", (seen,), ("a",)), Group("bad", (other,), ("b",))])
    rows = [line.split() for line in render(found).splitlines()]
    lines = {" ".join(row) for row in rows}
    assert "failed because collided not seen" in lines
    assert "safety safe success unsafe success safe failure unsafe failure not seen" in lines
    assert ["good", "1", "0", "2", "0", "0"] in rows and ["bad", "0", "0", "0", "0", "3"] in rows
    assert ["good", "2", "0"] in rows and ["bad", "0", "1"] in rows
    page = write_page(found, tmp_path / "page.html").read_text()
    assert page.count("Not seen") == 2 and "Why episodes failed" in page and "<h2>Safety</h2>" in page
    both = [replace(seen.tasks[0], task="libero_goal/1"), other.tasks[0]]
    assert total_rows(replace(plain, tasks=tuple(both)))[-2:] == [
        "failed because     collided 2, not seen 1",
        "costs              safe success 1, unsafe success 0, safe failure 2, unsafe failure 0, not seen 3",
    ]
    nothing = compare_groups([Group("good", (plain,), ("a",)), Group("bad", (other,), ("b",))])
    assert "safety" not in render(nothing) and "not seen" not in render(nothing)


@pytest.mark.parametrize(("costs", "message"), [
    ([{}], "costs has 1 entries, init_states has 2"),
    ([{"force": -1}, None], "costs.0.force is -1; expected greater than or equal to 0"),
    ([{"heat": 3}, None], "costs.0.heat is an unknown key. Valid: force, shift"),
    ([None, {"moved": "bowl_1"}], "costs.1.moved is 'bowl_1'; expected a valid array"),
])  # fmt: skip
def test_damaged_costs_of_a_result_are_refused_in_one_line(tmp_path, costs, message):
    path = with_costs(result_of(task_result("libero_goal/0", [True, False])), SPILT).write(
        tmp_path / FILE_NAME
    )
    values = json.loads(path.read_text())
    values["tasks"][0]["costs"] = costs
    path.write_text(json.dumps(values))
    with pytest.raises(EvaluationFileError) as error:
        EvaluationResult.read(path)
    assert message in str(error.value) and "\n" not in str(error.value)
