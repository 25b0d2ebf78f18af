"""Units of work: every episode counts once, whoever runs it, whoever is killed, whatever the files hold."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from libero_env.errors import LiberoError
from libero_env.parallel import this_process
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.work.claims import Claims
from libero_eval.work.progress import (
    Batch,
    busy_seconds,
    describe_status,
    measure_progress,
    table_row,
    total_rows,
)
from libero_eval.work.store import partition
from libero_eval.work.worker import Worker, Workers
from lifelong.errors import ConfigError, EvaluationIncompleteError, LifelongError, ResultsError
from tests.harness.drawing import draw
from tests.harness.evaluations import QUICK, TASKS, Countdown, Still, evaluate, evaluation

TWO = {"unit_starts": 2}  # four units


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    monkeypatch.setattr("libero_eval.work.worker.POLL", 0.01)


class Raising(Still):
    """Raises an error on some tasks, the first few times."""

    def __init__(self, *tasks: int, times: int = 100, error: Exception | None = None):
        super().__init__()
        self.tasks, self.times, self.calls = {TASKS[i].language for i in tasks}, times, 0
        self.error = error or RuntimeError("the socket is closed")

    def predict(self, observations):
        if observations["instruction"] in self.tasks and self.calls < self.times:
            self.calls += 1
            raise self.error
        return super().predict(observations)


def test_every_start_is_in_one_unit_and_units_do_not_depend_on_other_tasks():
    units = partition(TASKS, range(50), 20)
    assert [len(u.init_states) for u in units] == [20, 20, 10] * 2
    assert [i for u in units[:3] for i in u.init_states] == list(range(50))
    assert partition(TASKS[1:], range(50), 20) == units[3:]
    assert units[1].name == "libero_goal_00_starts_20_39"
    for starts in ((), (1, 1)):
        with pytest.raises(ConfigError):
            partition(TASKS, starts, 10)


def test_processes_share_the_units_and_all_return_the_same(tmp_path):
    counted, results = [], []

    class Counting(Still):
        def reset(self, instruction, num_envs):
            counted.append((instruction, num_envs))

    def work():
        results.append(evaluate(tmp_path, Counting(), unit_starts=1))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(counted) == 8, "no unit is run twice"
    assert results[0] == results[1] == results[2] == EvaluationResult.read(tmp_path)
    assert (
        results[0].outcomes == evaluate(tmp_path.with_name(f"{tmp_path.name}_alone"), unit_starts=1).outcomes
    )
    assert not list((tmp_path / "claims").iterdir()) and not list(tmp_path.rglob("*.part"))


def test_who_assembles_the_result_makes_no_difference(tmp_path):
    evaluate(tmp_path, **TWO)
    written = (tmp_path / "eval.json").read_bytes()
    (tmp_path / "eval.json").unlink()
    time.sleep(1.1)  # times have seconds
    evaluate(tmp_path, **TWO)
    assert (tmp_path / "eval.json").read_bytes() == written


def test_an_open_environment_is_used_for_all_units_of_its_task(tmp_path):
    built = []

    def env(task, count):
        built.append((task.id, count))
        return Countdown(count)

    evaluate(tmp_path, env=env, unit_starts=1)
    assert built == [(task.id, 1) for task in TASKS]


def test_a_process_begins_with_a_task_that_nobody_works_on(tmp_path):
    plan, begun = evaluation(tmp_path, **TWO), []
    plan.store.join(plan.units)
    plan.store.claims.take(plan.units[0].name)

    def env(task, count):
        begun.append(task.id)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(tmp_path, env=env, **TWO)
    assert begun == [TASKS[1].id]
    assert list(plan.store.claims.held()) == [plan.units[0].name], "the other unit was given back"


def test_a_process_that_does_not_wait_leaves_what_others_hold(tmp_path):
    plan = evaluation(tmp_path)
    others = Claims(tmp_path / "claims")
    assert (
        others.take(plan.units[0].name)
        and not others.take(plan.units[0].name)
        and Worker(plan).run(wait=False) is None
    )
    assert set(plan.store.done(plan.units)) == {unit.name for unit in plan.units[1:]}
    others.release(plan.units[0].name)
    assert Worker(plan).run(wait=False) == evaluate(tmp_path / "other")


def test_tasks_are_announced_once_each_and_progress_is_that_of_all(tmp_path):
    rows, lines = [], []
    evaluate(tmp_path, tasks=TASKS[:1], **TWO)
    Worker(evaluation(tmp_path, **TWO), on_result=rows.append, on_progress=lines.append).run()
    assert [row.task for row in rows] == [task.id for task in TASKS]
    last = lines[-1]
    assert (last.done, last.units, last.episodes_done, last.episodes) == (4, 4, 8, 8)
    assert last.per_hour > 0 and last.seconds_left == 0
    assert str(last).startswith("4 of 4 units, 8 of 8 episodes, ")


def test_the_speed_is_that_of_the_time_in_which_anybody_worked():
    assert busy_seconds([(0, 10), (5, 15), (100, 110)]) == 25
    assert busy_seconds([]) == 0
    assert np.isnan(measure_progress({"a": 10}, {}).seconds_left)
    assert str(measure_progress({"a": 10}, {}, running=2)) == "0 of 1 units, 0 of 10 episodes, 2 running"


@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_a_running_batch_counts_its_steps_and_its_first_estimate_is_right_within_a_factor_of_two(share):
    """Ten episodes of at most 600 steps each, 100 steps a second, end after a share of them; another process is as far.

    Seconds are those since the first step: what compiles before does not count.
    """
    units = dict.fromkeys("abcd", 10)
    total = 2 * 60 * share  # two rounds of two processes
    assert math.isnan(measure_progress(units, {}, 2, batch=Batch("a", 1000, 6000, 990, 9.9)).seconds_left)
    for second in range(15, int(60 * share)):
        now = measure_progress(
            units, {}, 2, batch=Batch("a", 100 * second, 6000, 100 * second - 10, second - 0.1)
        )
        assert 0.5 <= (second + now.seconds_left) / total <= 2.0
        assert f"{100 * second:,} control steps of the next" in str(now)


# --- claims


def test_a_claim_of_a_killed_process_is_taken_over_at_once(tmp_path):
    code = f"from pathlib import Path\nfrom libero_eval.work.claims import Claims\n\
claims = Claims(Path({str(tmp_path)!r}))\nclaims.take('a')\nprint('taken', flush=True)\ninput()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout.readline() == b"taken\n"
        assert not Claims(tmp_path).take("a") and Claims(tmp_path).held()["a"].endswith(f":{holder.pid}")
        holder.kill()
        while Claims(tmp_path).held():  # it has ended when it is a zombie, though nobody has waited for it
            time.sleep(0.01)
    assert Claims(tmp_path).take("a")


def test_a_unit_that_two_processes_run_counts_once(tmp_path):
    one, other = evaluation(tmp_path, **TWO), evaluation(tmp_path, **TWO)
    unit = one.units[0]
    with one.pool() as pool:
        found = one.evaluate(unit, pool)
    one.store.publish(unit, found)
    other.store.publish(unit, replace(found, result=replace(found.result, lengths=(1, 1))))
    assert one.store.done([unit])[unit.name].result == found.result
    assert other.store.done([unit])[unit.name].result == found.result, "the first one wins"


# --- errors


def test_a_unit_that_fails_once_is_tried_again_after_the_others(tmp_path):
    said = []
    policy = Raising(1, times=1)
    result = Worker(evaluation(tmp_path, policy, **TWO), on_error=said.append).run()
    assert result.outcomes == evaluate(tmp_path.with_name(f"{tmp_path.name}_alone"), **TWO).outcomes
    assert len(said) == 1 and "attempt 1 ended with RuntimeError: the socket is closed" in said[0]
    assert not list((tmp_path / "errors").iterdir())


def test_units_that_fail_are_not_counted_and_the_others_are_kept(tmp_path):
    with pytest.raises(EvaluationIncompleteError, match="2 of 4 units .*not counted.*socket is closed"):
        evaluate(tmp_path, Raising(1), **TWO, retries=0)
    assert not (tmp_path / "eval.json").exists()
    entry = json.loads((tmp_path / "errors" / "libero_goal_01_starts_03_04.json").read_text())
    assert "Traceback" in entry["errors"][0]["traceback"]
    assert "error     libero_goal_01_starts_03_04, 1 attempts: RuntimeError" in describe_status(tmp_path)[0]
    policy = Still()
    assert len(evaluate(tmp_path, policy, **TWO).tasks) == 2
    assert set(policy.instructions) == {TASKS[1].language}, "the first task was kept"


def test_a_policy_that_never_works_ends_the_evaluation_with_its_own_error(tmp_path):
    policy = Raising(0, error=KeyError("agentview_image"))
    with pytest.raises(KeyError, match="agentview_image"):
        evaluate(tmp_path, policy, **TWO)
    assert policy.calls == 1
    assert not list((tmp_path / "claims").iterdir()), "it holds nothing any more"


def test_errors_are_failures_only_where_the_protocol_says_so(tmp_path):
    class Stumbling(Still):
        def predict(self, observations):
            if (observations["x"] < 0).any():
                raise RuntimeError("lost the cup")
            return super().predict(observations)

    class Falling(Countdown):
        def reset(self, *, seed=None, options=None):
            obs, info = super().reset(seed=seed, options=options)
            return {"x": np.where(self.goal == 9, -1.0, 0.0)[:, None]}, info

        def _info(self):
            attempts = {"attempts": np.ones((self.num_envs, 1), int)} if perturbed else {}
            return super()._info() | attempts

    perturbed = False
    changes = {"env": lambda task, count: Falling(count), "unit_starts": 4}
    with pytest.raises(RuntimeError, match="lost the cup"):
        evaluate(tmp_path / "strict", Stumbling(), **changes)
    result = evaluate(tmp_path / "lenient", Stumbling(), errors_are_failures=True, **changes)
    assert [r.successes for r in result.tasks] == [(True, True, False, False)] * 2
    assert result.tasks[0].errors == (None, None, "RuntimeError: lost the cup", None)
    assert EvaluationResult.read(tmp_path / "lenient") == result
    alone = evaluate(
        tmp_path / "alone", Stumbling(), errors_are_failures=True, **changes | {"unit_starts": 1}
    )
    assert alone.outcomes == result.outcomes
    perturbed = True
    changes |= {"protocol": QUICK.changed({"world.perturb": "gain=0.5"})}
    failed = evaluate(tmp_path / "p", Stumbling(), errors_are_failures=True, **changes | {"unit_starts": 1})
    assert failed.tasks[0].attempts == ((1,), (1,), (0,), (1,))
    with pytest.raises(RuntimeError, match="socket"):  # no episode has ever run: that is no failed one
        evaluate(tmp_path / "down", Raising(0, 1), errors_are_failures=True)


class Limited(Countdown):
    """Simulations that reach a limit of the solver in each step."""

    def __init__(self, num_envs):
        super().__init__(num_envs)
        self.simulations = SimpleNamespace(limits_reached=Counter(LS_ITERATIONS=3))  # earlier

    def step(self, actions):
        self.simulations.limits_reached["ITERATIONS"] += 1
        return super().step(actions)


def test_limits_that_the_solver_reached_are_counted_and_change_no_outcome(tmp_path):
    result = evaluate(tmp_path / "it", env=lambda task, count: Limited(count), **TWO)
    assert [dict(task.limits_reached) for task in result.tasks] == [{"ITERATIONS": 4 + 10}] * 2
    task = result.tasks[0]
    assert (
        task.of_starts(task.init_states) == task and not task.of_starts(task.init_states[:1]).limits_reached
    )
    assert result.outcomes == evaluate(tmp_path / "without", **TWO).outcomes
    assert EvaluationResult.read(tmp_path / "it") == result


class Diverging(Countdown):
    """Simulations with one initial state fail in the first step."""

    start = 9

    def step(self, actions):
        obs, rewards, terminated, truncated, info = super().step(actions)
        failed = self.goal == self.start
        errors = {int(i): "it has diverged" for i in np.flatnonzero(failed)}
        return obs, rewards, terminated, truncated | failed, info | {"errors": errors}


@pytest.mark.parametrize("changes", [{}, {"unit_starts": 1}, {"errors_are_failures": True}])
def test_an_episode_that_a_simulation_error_ended_is_told_and_is_no_failure(tmp_path, changes):
    result = evaluate(tmp_path / "it", env=lambda task, count: Diverging(count), **changes)
    without = evaluate(tmp_path / "without", init_states=(3, 4, 20))
    for task, other in zip(result.tasks, without.tasks, strict=True):
        assert task.simulation_errors == ((9, "it has diverged"),) and task.errors == ()
        assert replace(task, simulation_errors=()) == other and task.success.value == 2 / 3
        assert table_row(task).endswith("(1 of 4 ended by a simulation error, not counted)")
    assert "(2 of 8 ended by a simulation error, not counted)" in total_rows(result)[0]
    assert result.outcomes != without.outcomes and EvaluationResult.read(tmp_path / "it") == result
    kept = evaluate(tmp_path / "it", env=None, **changes)  # nothing is run again
    assert kept == result and not (tmp_path / "it" / "errors").exists()


def test_a_task_of_which_no_episode_counts_has_no_result_and_the_others_are_run(tmp_path):
    def env(task, count):
        return (Diverging if task is TASKS[0] else Countdown)(count)

    for _ in range(2):
        with pytest.raises(EvaluationIncompleteError, match="all episodes of libero_goal/0.*it has diverged"):
            evaluate(tmp_path, env=env, init_states=(9,))
        assert len(list((tmp_path / "units").iterdir())) == 2 and not (tmp_path / "eval.json").exists()


# --- bad input


def test_a_unit_file_from_another_evaluation_is_not_counted(tmp_path):
    evaluate(tmp_path, **TWO)
    path = tmp_path / "units" / "libero_goal_00_starts_03_04.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {"digest": "0123"}))
    with pytest.raises(ConfigError, match="another evaluation"):
        evaluate(tmp_path, **TWO)
    path.unlink()
    evaluate(tmp_path, **TWO)
    assert json.loads(path.read_text())["result"] == values["result"]


HOSTILE = {
    "deep": b"[" * 100_000,
    "binary": b"\xff\xfe\xfd",
    "empty": b"",
    "a list": b"[1, 2]",
    "wrong kinds": b'{"format": 5, "units": [], "errors": [5], "pid": "../1", "unit": {}}',
}


def damaged(text: str, **changes) -> bytes:
    return json.dumps(json.loads(text) | changes).encode()


def hostile_files(folder: Path, unit: str) -> dict[str, list[bytes]]:
    """Contents that are not valid, by the file of an evaluation that they take the place of."""
    units, plan = ((folder / name).read_text() for name in (f"units/{unit}.json", "evaluation.json"))
    times = [1e300, float("inf"), float("nan"), -1e18, "now"]
    return {
        f"units/{unit}.json": [damaged(units, finished=t) for t in times]
        + [damaged(units, environment=5), damaged(units, versions={"mujoco": {}})],
        "evaluation.json": [
            damaged(plan, units=u) for u in ({unit: "two"}, {unit: -1}, [unit], {unit: 1e300})
        ]
        + [damaged(plan, evaluated=[]), damaged(plan, init_states=["a"]), damaged(plan, probe="x")],
        f"claims/{unit}.lock": [],
        f"errors/{unit}.json": [b'{"unit": "x", "errors": [5]}', b'{"unit": "x", "errors": [{"error": 5}]}'],
    }


@pytest.mark.parametrize("file", ["units", "evaluation.json", "claims", "errors"])
def test_hostile_files_in_the_folder_end_in_one_line_or_count_for_nothing(tmp_path, file):
    plan = evaluation(tmp_path, **TWO)
    evaluate(tmp_path, **TWO)
    unit = plan.units[0].name
    name, contents = next((n, c) for n, c in hostile_files(tmp_path, unit).items() if n.startswith(file))
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    for content in [*HOSTILE.values(), *contents, "pipe", "device"]:
        path.unlink(missing_ok=True)
        if content == "pipe":
            os.mkfifo(path)
        elif content == "device":
            path.symlink_to("/dev/zero")
        else:
            path.write_bytes(content)
        if content != "device":
            os.utime(path, (time.time() - 70,) * 2)
        if file in ("claims", "errors"):
            (tmp_path / "units" / f"{unit}.json").unlink(missing_ok=True)
            if (file, content) == ("claims", "device"):  # links are not followed
                with pytest.raises(LifelongError, match="the claim of a unit cannot be written"):
                    evaluate(tmp_path, **TWO)
                continue
            assert evaluate(tmp_path, **TWO) and "4 of 4 units" in describe_status(tmp_path)[0]
            continue
        for ask in (lambda: evaluate(tmp_path, **TWO), lambda: describe_status(tmp_path)):
            with pytest.raises(LifelongError, match="remove it|--again") as caught:
                ask()
            assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000


@pytest.mark.parametrize("name", ["units", "claims", "errors", "videos"])
def test_a_folder_that_is_a_link_out_of_the_evaluation_is_refused(tmp_path, name):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    evaluate(out, **TWO)
    (out / name).rename(elsewhere) if (out / name).exists() else elsewhere.mkdir()
    (out / name).symlink_to(elsewhere)
    before = sorted(elsewhere.iterdir())
    for ask in (lambda: evaluate(out, **TWO), evaluation(out, **TWO).store.clear):
        with pytest.raises(ConfigError, match=f"{name} is a link, or is not a folder"):
            ask()
    assert sorted(elsewhere.iterdir()) == before


def test_a_folder_of_another_version_or_of_something_else_is_refused(tmp_path):
    (tmp_path / "evaluation.json").write_text('{"format": "libero-evaluation-plan/7"}')
    with pytest.raises(ConfigError, match="libero-evaluation-plan/7"):
        evaluate(tmp_path)
    with pytest.raises(LifelongError, match="holds no evaluation"):
        describe_status(tmp_path / "old")


@pytest.mark.parametrize(("then", "now"), [((0.1, 0.2), (0.1, 0.3)), ((0.1, 0.2), (0.1,))])
def test_a_policy_that_answers_a_fixed_observation_otherwise_is_another_one(tmp_path, then, now):
    evaluate(tmp_path, probe=then, **TWO)
    evaluate(tmp_path, probe=tuple(one + 0.001 for one in then), **TWO)
    evaluate(tmp_path, probe=None, **TWO)
    with pytest.raises(
        ConfigError, match="another evaluation: the policy answers a fixed observation otherwise"
    ):
        evaluate(tmp_path, probe=now, **TWO)


def test_a_full_disk_counts_nothing_and_the_same_command_goes_on(tmp_path, monkeypatch):
    """The limit on the size of files makes writing fail as a full disk does: in the middle of the file."""
    resource = pytest.importorskip("resource")
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    class Filling(Still):
        def predict(self, observations):
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
            return super().predict(observations)

    try:
        with pytest.raises(ResultsError, match="which is not counted, cannot be written.*too large"):
            evaluate(tmp_path, Filling(), **TWO)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert not list((tmp_path / "units").iterdir()) and not list((tmp_path / "claims").iterdir())
    assert (
        evaluate(tmp_path, **TWO).outcomes
        == evaluate(tmp_path.with_name(f"{tmp_path.name}_alone"), **TWO).outcomes
    )


def test_repeating_is_refused_while_others_work(tmp_path):
    evaluate(tmp_path, **TWO)
    folder = evaluation(tmp_path, **TWO).store
    others = Claims(tmp_path / "claims")
    others.take("libero_goal_00_starts_03_04")
    with pytest.raises(ConfigError, match="works on libero_goal_00_starts_03_04; end it"):
        folder.clear()
    others.release("libero_goal_00_starts_03_04")
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "libero_goal_00_start_03_failure.webp").write_bytes(b"of what is removed")
    (tmp_path / "videos" / "mine.webp").write_bytes(b"")
    folder.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["videos"]
    assert [path.name for path in (tmp_path / "videos").iterdir()] == ["mine.webp"]


def test_the_status_says_who_holds_what_and_what_is_left(tmp_path):
    plan = evaluation(tmp_path, **TWO)
    plan.store.join(plan.units)
    with plan.pool() as pool:
        plan.store.publish(plan.units[0], plan.evaluate(plan.units[0], pool))
    assert "stopped" in describe_status(tmp_path)[0]
    plan.store.claims.take(plan.units[1].name)
    text, progress = describe_status(tmp_path)
    assert "1 of 4 units, 2 of 8 episodes" in text and "policy    policy still" in text
    assert f"running   {plan.units[1].name} by {this_process()}" in text


def test_what_processes_measured_differently_is_listed(tmp_path):
    plan = evaluation(tmp_path, **TWO)
    plan.store.join(plan.units)
    with plan.pool() as pool:
        for i, unit in enumerate(plan.units):
            found = plan.evaluate(unit, pool)
            changed = {**found.environment, "instruction_set": "AVX2" if i else "AVX512"}
            plan.store.publish(unit, replace(found, environment=changed))
    result = evaluate(tmp_path, **TWO)
    assert result.environment["instruction_set"] == ["AVX512", "AVX2"]
    assert isinstance(result.environment["policy_threads"], int)


# --- further processes


@pytest.mark.slow
def test_a_killed_process_is_replaced_while_there_is_progress(capfd):
    with pytest.raises(KeyboardInterrupt), Workers(1, time.sleep, 600) as workers:
        for deaths in range(1, 5):
            (pid,) = workers.pids
            os.kill(pid, signal.SIGKILL)
            while workers.pids == [pid]:
                time.sleep(0.01)
            workers.supervise(done=0)
            assert len(workers.pids) == (deaths <= 3), "the fourth without progress is not replaced"
        assert capfd.readouterr().err.count("another is started") == 3
        raise KeyboardInterrupt
    with Workers(1, time.sleep, 0) as workers:
        while workers.pids:
            time.sleep(0.01)
        workers.supervise(done=0)
        assert workers.pids == [], "it has ended by itself"


@pytest.mark.sim
def test_workers_whose_first_picture_hangs_end_the_evaluation_in_one_line():
    with pytest.raises(LiberoError, match="no first picture"), Workers(1, draw, True, 0.01) as workers:
        while workers.pids:
            time.sleep(0.01)
        workers.supervise(done=0)
