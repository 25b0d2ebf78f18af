"""A base stage of several tasks before the others: sequences, records, metrics, and runs that are killed in it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate

from lifelong.algorithms import LoRA
from lifelong.algorithms.multitask import Multitask
from lifelong.context import RunContext
from lifelong.evaluation.restore import LoadedRun
from lifelong.report.comparison import Plan
from lifelong.report.page import comparison_text, write_report
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord, RunRecord, TaskEndRecord, from_line, to_line
from lifelong.results.summary import summarize
from lifelong.stats.metrics import Curve, Scores, lifelong_metrics
from lifelong.streams import StreamSettings
from tests.harness import sequences
from tests.harness.algorithms import assert_resumed_equals_uninterrupted
from tests.harness.configs import FILES, chosen
from tests.harness.records import evaluation, run_start

pytestmark = pytest.mark.usefixtures("uncounted")
STREAM = StreamSettings(base_tasks=2)
ALGORITHMS = sorted(f.stem for f in FILES if str(f.parent) == "algo")


def record(sizes: tuple[int, ...]) -> RunRecord:
    return run_start([f"t{k}" for k in range(sum(sizes))], group_sizes=sizes)


def context(path: Path, algorithm, tasks: int = 4) -> RunContext:
    """Two tasks learned together, then the others one at a time, of one epoch each."""
    found = sequences.run_context(path, "sequential", tasks)
    if not found.directory.log.read().records:
        found.directory.log.append(record(STREAM.group_sizes(tasks)))
    fit = replace(found.fit, epochs=1, steps_per_epoch=1, batch_size=4)
    measured = replace(found.eval, episodes=1, curve_episodes=1, horizon=2)
    return replace(found, algorithm=algorithm, fit=fit, eval=measured, group_sizes=STREAM.group_sizes(tasks))


def algorithm(name: str):
    return instantiate(chosen("algo", name), _convert_="all")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_a_base_stage_first(tmp_path, name) -> None:
    learner = algorithm(name)
    sequences.sequence(context(tmp_path, learner, tasks=3)).run()
    results = ResultLog(tmp_path / "results.jsonl").read()
    ends = [2] if isinstance(learner, Multitask) else [1, 2]
    assert [r.task for r in results.of(TaskEndRecord)] == ends
    cells = {(r.learned, r.task) for r in results.of(EvalRecord) if r.phase == "matrix"}
    assert cells == {(last, task) for last in ends for task in range(last + 1)}
    assert results.learned_tasks() == 3
    if len(ends) > 1:
        assert results.scores().matrix.shape == (2, 2)
        assert set(results.curves()) == {0, 1, 2}


def test_adapters_have_the_base_stage_as_their_base(tmp_path) -> None:
    learner = LoRA(base_tasks=1)
    sequences.sequence(context(tmp_path, learner)).run()
    state = learner.state_dict()
    assert state["base_last"] == 1 and set(state["library"]) == {2, 3}
    results = ResultLog(tmp_path / "results.jsonl").read()
    for task in (0, 1):
        first, *later = (results.evaluation("matrix", row, task) for row in (1, 2, 3))
        assert [r.lengths for r in later] == [first.lengths] * 2


@pytest.mark.parametrize("name", ["er", "lora"])
def test_a_run_killed_in_and_after_its_base_stage_ends_in_the_same_bits(tmp_path, monkeypatch, name) -> None:
    make = lambda path, name: context(path, algorithm(name))  # noqa: E731
    assert_resumed_equals_uninterrupted(tmp_path, name, monkeypatch, make, last=3)


def fill(log: ResultLog, cells: dict[tuple[str, int, int, int], float]) -> None:
    """Append evaluations of ten episodes, by (phase, task learned, epoch, task)."""
    for (phase, learned, epoch, task), rate in cells.items():
        log.append(evaluation(phase, learned, epoch, task, round(10 * rate), 10))


def fill_base(log: ResultLog) -> None:
    base = {("curve", 2, 0, task): 0.0 for task in range(3)}
    base |= {("curve", 2, 5, task): rate for task, rate in enumerate((0.9, 0.6, 0.6))}
    base |= {("matrix", 2, 5, task): rate for task, rate in enumerate((0.9, 0.6, 0.6))}
    fill(log, base)


def fill_later(log: ResultLog, learned: float) -> None:
    fill(log, {("curve", 3, 0, 3): 0.2, ("curve", 3, 5, 3): learned})
    fill(log, {("matrix", 3, 5, task): rate for task, rate in enumerate((0.3, 0.3, 0.3, learned))})
    fill(log, {("curve", 4, 0, 4): 0.0, ("curve", 4, 5, 4): 1.0})
    fill(log, {("matrix", 4, 5, task): rate for task, rate in enumerate((0.1, 0.2, 0.3, 0.6, 1.0))})


def test_metrics_count_the_base_stage_as_one_task_and_the_later_tasks_are_measured_alone(tmp_path) -> None:
    log = ResultLog(tmp_path / "results.jsonl")
    log.append(record((3, 1, 1)))
    fill_base(log)
    assert log.read().learned_tasks() == 3
    assert log.read().after_base_stage() is None, "no later task is learned"
    fill_later(log, 0.8)
    results = log.read()
    assert results.learned_tasks() == 5

    found = lifelong_metrics(results.scores())
    fwt = np.array([(0 + 0.7) / 2, (0.2 + 0.8) / 2, (0 + 1.0) / 2])  # of the groups
    nbt = np.array([0.7 - (0.3 + 0.2) / 2, 0.8 - 0.6, 0])
    auc = np.array([(fwt[0] + 0.3 + 0.2) / 3, (fwt[1] + 0.6) / 2, fwt[2]])
    np.testing.assert_allclose(
        [found.fwt.value, found.nbt.value, found.auc.value], [v.mean() for v in (fwt, nbt, auc)]
    )
    np.testing.assert_allclose(found.nbt_by_task, np.repeat(nbt, (3, 1, 1)))
    np.testing.assert_allclose(found.final_success.value, (3 * 0.2 + 0.6 + 1.0) / 5)  # of all tasks

    later = results.after_base_stage()
    assert later is not None
    np.testing.assert_allclose(later.fwt_by_task, fwt[1:])
    np.testing.assert_allclose(later.nbt_by_task, nbt[1:])
    np.testing.assert_allclose(later.auc_by_task, auc[1:])
    summary = summarize(results)
    assert summary["metrics_after_base_stage"]["nbt"]["value"] == later.nbt.value
    page = write_report([tmp_path]).read_text(encoding="utf-8")
    assert "The 3 tasks that were learned together first count as one" in page


def test_a_comparison_measures_the_later_tasks_alone(tmp_path) -> None:
    runs = {}
    for algo, learned in (("first", 0.8), ("second", 0.6), ("base_only", None)):
        runs[algo] = tmp_path / algo
        log = ResultLog(runs[algo] / "results.jsonl")
        log.append(replace(record((3, 1, 1)), algo=algo))
        fill_base(log)
        if learned is not None:
            fill_later(log, learned)
    page = write_report(list(runs.values()), tmp_path / "page", Plan(all_pairs=True))
    found = json.loads((page.parent / "comparison.json").read_text(encoding="utf-8"))
    later = found["after_base_stage"]
    assert list(later["metrics"]) == ["first", "second"], "without a later task there is nothing to measure"
    for algo in later["metrics"]:
        alone = ResultLog(runs[algo] / "results.jsonl").read().after_base_stage()
        for name in ("fwt", "nbt", "auc", "final_success", "just_learned"):
            assert later["metrics"][algo][name]["mean"] == pytest.approx(getattr(alone, name).value)
    (pair,) = later["differences"]
    assert pair["metrics"]["just_learned"]["value"] == pytest.approx((0.8 - 0.6) / 2)
    assert len(found["differences"]) == 3
    text = page.read_text(encoding="utf-8")
    assert "Of the later tasks alone, as if the sequence began with them" in text
    assert "<dt>tasks learned together first</dt><dd>3</dd>" in text
    rows = text.split("Differences between methods")[1].split("Of the later tasks alone:")
    assert [part.split("</details>")[0].count("first − second") for part in rows] == [1, 1], (
        "one row in each table"
    )
    assert any(line.startswith("Later tasks alone: ") for line in comparison_text(page))


def test_without_a_base_stage_nothing_is_measured_apart(tmp_path) -> None:
    for sizes in ((1, 1), (2, 2), (4,)):
        assert not record(sizes).has_base_stage
    curves = tuple(Curve(np.array([0]), np.array([rate]), np.array([5])) for rate in (0.2, 0.4))
    scores = Scores(curves, np.array([[0.2, np.nan], [0.1, 0.4]]), np.array([[5, 0], [5, 5]]))
    assert scores.without_first().matrix.tolist() == [[0.4]]


def test_records_keep_the_sizes_of_groups() -> None:
    found = from_line(to_line(record((6, 1, 1))))
    assert isinstance(found, RunRecord)
    assert [*map(list, found.groups)] == [[0, 1, 2, 3, 4, 5], [6], [7]] and found.has_base_stage
    assert found.group(3) == range(6) and found.group(7) == range(7, 8)
    pairs = record((2, 2, 2))
    assert [len(group) for group in pairs.groups] == [2, 2, 2]
    with pytest.raises(ValueError, match="3 tasks are not groups of 2, 2"):
        replace(record((2, 1)), group_sizes=(2, 2))


def test_the_preset_of_the_stream_is_the_published_one() -> None:
    stream = instantiate(chosen("stream", "pretrained6"), _convert_="all")
    assert stream.group_sizes(10) == (6, 1, 1, 1, 1)
    assert stream.demos(50, 10, first=6) == (50,) * 6 + (10,) * 4
    assert stream.blur == 0


def test_a_loaded_run_acts_with_the_adapter_of_the_stage(tmp_path) -> None:
    learner = LoRA(base_tasks=1)
    found = context(tmp_path, learner)
    sequences.sequence(found).run()
    asked = []
    learner.policy_for = lambda stage, policy: asked.append(stage) or LoRA.policy_for(learner, stage, policy)  # type: ignore[method-assign]
    given = {
        "path": tmp_path,
        "checkpoint": tmp_path,
        "learned": 3,
        "language": None,
        "instructions": (),
        "data": None,
    }
    of_run = ("tasks", "policy", "algorithm", "eval", "seed", "device", "group_sizes")
    run = LoadedRun(**given, **{name: getattr(found, name) for name in of_run})
    for task in found.tasks:
        with run.acting(task):
            pass
    assert asked == [1, 1, 2, 3]
