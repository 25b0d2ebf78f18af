"""Records stay readable after a killed process or a full disk."""

import gzip
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.comparisons.episodes import read_episodes
from lifelong.errors import ResultsError
from lifelong.results.log import ResultLog
from lifelong.results.records import (
    CostRecord,
    EvalRecord,
    LossRecord,
    PhaseRecord,
    RunEndRecord,
    TaskEndRecord,
    from_line,
    signed_line,
    to_line,
)
from lifelong.results.results import Results
from lifelong.results.summary import summarize, write_episodes, write_summary
from lifelong.stats.metrics import metric_values
from tests.harness.records import evaluation, run_start

START = run_start(["first_task", "second_task"])


RUN = [
    START,
    PhaseRecord(phase="demos", seconds=30.0),
    evaluation("curve", 0, 0, 0, 0),
    LossRecord(task=0, epoch=1, loss=-3.25, seconds=2.0),
    evaluation("curve", 0, 1, 0, 3),
    evaluation("matrix", 0, 1, 0, 2),
    CostRecord(task=0, costs={"stored_bytes": 12.0}),
    TaskEndRecord(task=0, best_epoch=1, seconds=10.0),
    evaluation("curve", 1, 0, 1, 1),
    LossRecord(task=1, epoch=1, loss=-4.0, seconds=2.0),
    evaluation("curve", 1, 1, 1, 4),
    evaluation("matrix", 1, 1, 0, 1),
    evaluation("matrix", 1, 1, 1, 4),
    TaskEndRecord(task=1, best_epoch=1, seconds=10.0),
    RunEndRecord(seconds=60.0, finished="2026-01-01T00:00:00+00:00"),
]


@pytest.fixture
def log(tmp_path: Path) -> ResultLog:
    log = ResultLog(tmp_path / "run" / "results.jsonl")
    for record in RUN:
        log.append(record)
    return log


def test_numbers_that_are_not_finite_stay_strict_json():
    line = to_line(LossRecord(task=0, epoch=1, loss=float("nan"), seconds=1.0))
    assert json.loads(line)["loss"] is None
    assert np.isnan(from_line(line).loss)


def test_reading_gives_back_what_was_appended(log: ResultLog):
    results = log.read()
    assert list(results.records) == RUN and results.problems == ()
    assert results.run == START and results.finished


def test_no_file_yet_is_an_empty_run(tmp_path: Path):
    results = ResultLog(tmp_path / "results.jsonl").read()
    assert results.records == () and results.evaluation("curve", 0, 0) is None
    with pytest.raises(ResultsError, match="stopped before it began"):
        _ = results.run


def test_each_line_is_parsed_once_however_often_it_is_read(log: ResultLog, monkeypatch: pytest.MonkeyPatch):
    parsed = []
    monkeypatch.setattr("lifelong.results.log.from_line", lambda line: parsed.append(line) or from_line(line))
    second = ResultLog(log.path)  # of another process, such as a report's
    more = [evaluation("matrix", 1, 1, 1, wins) for wins in range(4)]
    for record in more[:3]:
        log.append(record)
        assert all(log.read().records[-1] == record for _ in range(5))
    assert len(parsed) == 3
    assert second.read() == log.read() and len(parsed) == 3 + len(RUN) + 3
    second.append(more[3])
    assert log.read().records == (*RUN, *more) and second.read() == log.read()
    log.path.unlink()
    assert log.read() == second.read() == Results(())


def test_a_process_killed_at_any_byte_loses_at_most_the_last_record(log: ResultLog):
    whole = log.path.read_bytes()
    ends = [i + 1 for i, byte in enumerate(whole) if byte == ord("\n")]
    for cut in range(0, len(whole) - 1, 37):  # before the last record is whole: it is appended again
        log.path.write_bytes(whole[:cut])
        complete = sum(end <= cut for end in ends)
        found = log.read()
        assert list(found.records[:complete]) == RUN[:complete] and found.problems == ()
        assert len(found.records) <= complete + 1
        log.append(RUN[-1])
        assert log.read() == Results((*found.records, RUN[-1]))


def test_what_no_record_is_as_long_as_is_kept_and_named(log: ResultLog):
    with open(log.path, "ab") as file:
        file.write(b"z" * (9 << 20))
    assert log.read() == Results(tuple(RUN))
    log.append(START)
    assert list(log.read().records) == [*RUN, START] and "longer than 4 MiB" in log.read().problems[0]
    assert log.path.stat().st_size > 9 << 20


def test_any_flipped_digit_is_found():
    for record in RUN:
        line = to_line(record)
        for i, byte in enumerate(line):
            if chr(byte).isdigit():
                changed = line[:i] + (b"3" if byte != ord("3") else b"8") + line[i + 1 :]
                with pytest.raises(ValueError, match="record"):
                    from_line(changed)


def test_only_a_missing_newline_loses_nothing(log: ResultLog):
    log.path.write_bytes(log.path.read_bytes()[:-1])
    log.append(START)
    assert list(log.read().records) == [*RUN, START]


def test_reading_never_changes_the_file(log: ResultLog):
    broken = log.path.read_bytes()[:-7]
    log.path.write_bytes(broken)
    log.read()
    assert log.path.read_bytes() == broken


def _signed(text: str) -> str:
    return signed_line(json.loads(text)).decode().strip()


@pytest.mark.parametrize(("line", "message"), [
    ("{not json", "not JSON"),
    ('{"kind": "lost"}', "unknown kind of record 'lost'; valid: run, loss, collection"),
    (_signed('{"kind": "loss", "task": 0, "epoch": 1, "loss": 0.1}'), "seconds"),
    (_signed('{"kind": "loss", "task": "zero", "epoch": 1, "loss": 0.1, "seconds": 1}'),
     "a 'loss' record: task is 'zero'; expected a valid integer"),
    (_signed('{"kind": "task_end", "task": true, "best_epoch": 1, "seconds": 1}'),
     "a 'task_end' record: task is True"),
    ('{"kind": [1]}', "unknown kind"),
    ("[" * 50_000, "not JSON"),
    (_signed('{"kind": "cost", "task": 0, "costs": {"bytes": "many"}}'), "costs.bytes is 'many'"),
    (_signed('{"kind": "loss", "task": -1, "epoch": 1, "loss": 0.1, "seconds": 1}'),
     "task is -1; expected greater than or equal to 0"),
    (_signed('{"kind": "loss", "task": 2, "epoch": 1, "loss": 0.1, "seconds": 1}'), "task 2, of 2 from 0 on"),
    (to_line(evaluation("unseen", 1, 1, 2, 1)).strip().decode(), "task 2, of 2 from 0 on"),
    ('{"kind": "loss", "task": 0, "epoch": 1, "loss": 0.1, "seconds": 1e400}', "not JSON compliant"),
    (to_line(RUN[3]).decode().strip().replace("-3.25", "-3.26"), "does not have its checksum"),
    (to_line(RUN[2]).decode().strip(), "repeats line 3"),
    ("x" * (9 << 20), "longer than 4 MiB"),
])  # fmt: skip
def test_an_invalid_line_is_named_and_the_others_are_read(log: ResultLog, line: str, message: str):
    lines = log.path.read_text().splitlines()
    log.path.write_text("\n".join([*lines[:3], line, *lines[3:]]) + "\n")
    results = log.read()
    assert list(results.records) == RUN
    (problem,) = results.problems
    assert problem.startswith(f"{log.path}:4: ") and message in problem


def test_a_full_disk_leaves_whole_lines(log: ResultLog, monkeypatch: pytest.MonkeyPatch):
    before = log.path.read_bytes()

    def no_space(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(ResultsError, match="No space left.*is intact"):
        log.append(RUN[3])
    assert log.path.read_bytes() == before


def test_recorded_evaluations_and_losses_are_found(log: ResultLog):
    results = log.read()
    assert results.evaluation("matrix", 1, 0) == results.evaluation("matrix", 1, 0, epoch=1) == RUN[11]
    assert results.evaluation("matrix", 1, 0, epoch=2) is None and results.evaluation("curve", 1, 0) is None
    assert results.has_loss(0, 1) and not results.has_loss(0, 2)
    assert results.task_end(1).best_epoch == 1 and results.task_end(2) is None


def test_the_last_of_equal_keys_counts(log: ResultLog):
    log.append(evaluation("matrix", 1, 1, 0, 4))
    log.append(LossRecord(task=1, epoch=1, loss=-5.0, seconds=2.0))
    results = log.read()
    assert results.success_matrix()[0][1, 0] == 1.0
    assert results.losses()[1][1].tolist() == [-5.0]


def test_matrix_and_curves(log: ResultLog):
    results = log.read()
    rates, episodes = results.success_matrix()
    np.testing.assert_array_equal(rates, [[0.5, np.nan], [0.25, 1.0]])
    np.testing.assert_array_equal(episodes, [[4, 0], [4, 4]])
    curves = results.curves()
    assert curves[0].epochs.tolist() == [0, 1] and curves[0].rates.tolist() == [0.0, 0.75]
    assert results.seconds_by_phase() == {"demos": 30.0, "training": 4.0, "evaluation": 10.5}


def test_the_best_of_the_curve_replaces_a_diagonal_that_was_not_evaluated():
    records = [
        r for r in RUN if not (isinstance(r, EvalRecord) and r.phase == "matrix" and r.learned == r.task)
    ]
    rates, _ = Results(tuple(records)).success_matrix()
    assert rates[0, 0] == 0.75 and rates[1, 1] == 1.0
    unfinished = Results(tuple(r for r in records if not isinstance(r, TaskEndRecord)))
    assert np.isnan(unfinished.success_matrix()[0][0, 0])


def test_an_unfinished_run_is_measured_over_the_tasks_it_learned():
    results = Results(tuple(RUN[:12]))  # the second task's row is half there
    assert results.learned_tasks() == 1 and not results.finished
    summary = summarize(results)
    assert summary["tasks_learned"] == 1
    assert summary["metrics"]["final_success"]["value"] == 0.5
    assert summarize(Results((START,)))["metrics"] is None


@pytest.mark.parametrize("cells", ["all", "last_row"])
def test_the_episodes_of_an_unfinished_run_give_its_numbers_whatever_was_lost(cells, tmp_path: Path):
    """The third of four tasks is being learned; simulation errors ended an episode of two points of one curve."""
    won = {
        "successes": (True, False, True, True),
        "init_states": (0, 2, 3, 4),
        "simulation_errors": ((1, "boom"),),
    }
    lost = [replace(evaluation("curve", 0, epoch, 0, 2, 4), **won) for epoch in (1, 2)]
    lost[1] = replace(lost[1], init_states=(0, 1, 3, 4), simulation_errors=((2, "boom"),))
    cases = [
        evaluation("curve", 0, 0, 0, 1, 5),
        *lost,
        *(evaluation("curve", 1, e, 1, e, 5) for e in range(3)),
    ]
    cases += [evaluation("matrix", *key, 3) for key in ((0, 2, 0), (1, 2, 0), (1, 2, 1))] * (cells == "all")
    cases += [TaskEndRecord(task=task, best_epoch=2, seconds=1.0) for task in range(2)]
    cases += [evaluation("curve", 2, 0, 2, 1)]
    other = Results((run_start("abcd", seed=2), *(evaluation("matrix", 3, 0, task, 3) for task in range(4))))
    run = Results((run_start("abcd", cells=cells), *cases))
    file = write_episodes(tmp_path / "episodes.csv", [("er", run), ("er", other)])
    found = read_episodes(file)[0][1]
    assert found.run.tasks == run.run.tasks, "as the other run's rows name them"
    assert found.learned_tasks() == run.learned_tasks() == 2
    for name, value in metric_values(run.scores()).items():
        assert metric_values(found.scores())[name] == pytest.approx(value, nan_ok=True)
    text = file.read_text()
    rows = [line.split(",") for line in text.splitlines()]
    gone = [",".join([*row[:-2], "", ""] if row[10:13] == ["curve", "1", "0"] else row) for row in rows]
    assert gone != text.splitlines()
    file.write_text("\n".join(gone) + "\n")  # no episode of a cell counts
    assert read_episodes(file)[0][1].learned_tasks() == run.learned_tasks()
    damaged = tmp_path / "episodes.csv.gz"
    damaged.write_bytes(gzip.compress(text.encode())[:10] + b"damaged" * 9)
    with pytest.raises(ResultsError, match="the episodes cannot be read"):
        read_episodes(damaged)


def test_the_summary_is_strict_json_and_complete(log: ResultLog, tmp_path: Path):
    path = tmp_path / "results.json"
    written = write_summary(path, log.read(), {"seed": 1, "algo": {"name": "er"}})
    found = json.loads(path.read_text(), parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert found == written
    assert found["success_matrix"]["rates"] == [[0.5, None], [0.25, 1.0]]
    assert found["metrics"]["nbt"]["value"] == pytest.approx(0.125)
    assert found["metrics_diagonal_from_curve"]["nbt"]["value"] == pytest.approx(0.25)
    assert found["run"]["versions"]["mujoco"] and found["config"]["algo"] == {"name": "er"}
    assert [p.name for p in tmp_path.glob("*.part")] == []


def test_evaluations_without_episodes_are_refused():
    with pytest.raises(ValueError, match="no episodes"):
        evaluation("curve", 0, 0, 0, 0, episodes=0)
    with pytest.raises(ValueError, match="is one of curve, matrix, unseen, initial, shift, not 'test'"):
        evaluation("test", 0, 0, 0, 0)


def test_rollouts_before_the_first_task_are_no_cost_of_it() -> None:
    before, after = evaluation("initial", 0, 0, 1, 0), evaluation("matrix", 0, 5, 0, 3)
    results = Results((run_start("ab"), CostRecord(task=0, costs={"parameters": 1.0}), before, after))
    assert results.costs_by_task()[0]["evaluation_seconds"] == after.seconds


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_device_that_is_full_is_an_error_with_the_path():
    with pytest.raises(ResultsError, match="/dev/full"):
        ResultLog("/dev/full").append(RUN[3])


@pytest.mark.parametrize("to", [None, "/dev/zero", "victim"])
def test_records_are_neither_a_pipe_nor_where_a_link_leads(to, tmp_path: Path):
    path, victim = tmp_path / "results.jsonl", tmp_path / "victim"
    victim.write_text("without a newline at its end")
    os.mkfifo(path) if to is None else path.symlink_to(tmp_path / to)
    for use in (ResultLog(path).read, lambda: ResultLog(path).append(RUN[3])):
        with pytest.raises(ResultsError, match=r"results\.jsonl"):
            use()
    assert victim.read_text() == "without a newline at its end"
