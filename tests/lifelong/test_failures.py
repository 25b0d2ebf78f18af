"""Causes of failures and safety by task and after each task, and interference between learned tasks."""

from dataclasses import replace

from libero_env.sim.causes import Failure
from libero_env.sim.costs import Costs
from lifelong.report.tables import interference_table, tally_tables
from lifelong.results.failures import (
    QUADRANTS,
    causes_text,
    failure_score,
    rollout_summary,
    safety_score,
    safety_text,
)
from lifelong.results.records import from_line, to_line
from lifelong.results.results import Results
from tests.harness.records import evaluation, run_start

BOWL, CHEESE, DRAWER = "(On bowl_1 plate_1)", "(In cheese_1 bowl_1)", "(Open cabinet_1_top_region)"
DROPPED = Failure("dropped", "bowl_1", "table", handled=("bowl_1",))
ON_CHEESE = Failure("wrong object", "bowl_1", "cheese_1", handled=("cheese_1",))
OPENED = Failure("never reached", "bowl_1", handled=("cheese_1", "cabinet_1"), instead=(DRAWER,))


def cell(learned, task, atom, failures):
    wins = sum(one is None for one in failures)
    flags = tuple((one is None,) for one in failures)
    return evaluation(
        "matrix", learned, 0, task, wins, len(failures), atoms=(atom,), failures=failures,
        atoms_at_start=flags, atoms_ever=flags, atoms_at_end=flags,
    )  # fmt: skip


ROWS = [
    cell(0, 0, BOWL, (None, DROPPED)),
    cell(1, 0, BOWL, (None, ON_CHEESE)),
    cell(1, 1, CHEESE, (None, None)),
    cell(2, 0, BOWL, (ON_CHEESE, OPENED)),
    cell(2, 1, CHEESE, (None, DROPPED)),
    cell(2, 2, DRAWER, (None, None)),
]


def test_causes_and_interference_of_a_run():
    score = failure_score(Results((run_start(["a", "b", "c"]), *ROWS), ()))
    assert score.outcomes == ("dropped", "wrong object", "never reached")
    assert score.by_task == {0: {"wrong object": 1, "never reached": 1}, 1: {"dropped": 1}, 2: {}}
    assert score.after == {
        0: {"dropped": 1},
        1: {"wrong object": 1},
        2: {"dropped": 1, "wrong object": 1, "never reached": 1},
    }
    # the cheese is that of task 1, the open drawer the goal of task 2, and the bowl that was dropped that of task 0
    assert score.interference == {(0, 1): 1, (0, 2): 1, (1, 0): 1}
    names = ["bowl", "cheese", "drawer"]
    assert tally_tables(score, names)[0].rows[0] == [1, "bowl", 0, 1, 1]
    served = [[1, "bowl", "", 1, 1], [2, "cheese", 1, "", ""], [3, "drawer", "", "", ""]]
    assert interference_table(score, names).rows == served
    assert causes_text(ROWS) == "dropped 2, wrong object 2, never reached 1"
    half = failure_score(Results((run_start(["a", "b", "c"]), *ROWS[:3], ROWS[5])))  # its last row has begun
    assert half.by_task == {0: {"wrong object": 1}, 1: {}} and max(half.after) == 1


def test_records_keep_failures_and_runs_without_them_have_no_score():
    assert from_line(to_line(ROWS[3])) == ROWS[3]
    assert failure_score(Results((run_start(["a"]), evaluation("matrix", 0, 0, 0, 2)), ())) is None
    assert interference_table(None, []) is None


def test_safety_of_a_run_by_task_and_after_each():
    safe, spilt = Costs(force=3.0), Costs(shift=0.3, hits=2)
    rows = [replace(one, costs=(safe, spilt if one.learned == 2 else safe)) for one in ROWS]
    results = Results((run_start(["a", "b", "c"]), *rows), ())
    score = safety_score(results)
    assert score.by_task[1] == {
        "safe success": 1,
        "unsafe success": 0,
        "safe failure": 0,
        "unsafe failure": 1,
    }
    assert score.after[0] == {"safe success": 1, "unsafe success": 0, "safe failure": 1, "unsafe failure": 0}
    assert tally_tables(score, ["bowl", "cheese", "drawer"])[0].rows[0] == [1, "bowl", 0, 0, 1, 1]
    assert safety_text(rows[3:4]).endswith("unsafe failure 1 (unsafe by shift 1, hits 1)")
    assert rollout_summary(results)["safety"]["after"][2] == score.after[2]
    assert from_line(to_line(rows[0])) == rows[0]
    after = safety_score(Results((run_start(["a", "b", "c"]), *ROWS[:3], *rows[3:]), ())).after
    assert after[0] == {**dict.fromkeys(QUADRANTS, 0), "not seen": 2} and "not seen" not in after[2]
    assert safety_score(Results((run_start(["a"]), *ROWS[:1]), ())) is None and tally_tables(None, []) == []
