"""Rollouts that would repeat others are copied, to the same records; and a run measures what it is told to."""

import json
import time
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from experiments.comparisons.episodes import read_episodes
from libero_env.parallel import spawn_pool
from libero_eval.check import examine
from lifelong.algorithms import LoRA, PackNet, Sequential, SingleTask
from lifelong.errors import ConfigError, TrainingError
from lifelong.evaluation.beside import RolloutProcess
from lifelong.evaluation.environments import EnvPool
from lifelong.evaluation.settings import EvalSettings
from lifelong.experiment import with_chosen
from lifelong.report import write_report
from lifelong.results.cells import sampled_tasks
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord
from lifelong.results.run_directory import RunDirectory
from lifelong.results.summary import summarize, write_episodes
from lifelong.seeding import seeded
from lifelong.sequence import is_measured
from lifelong.sequence.measuring import digest
from lifelong.sequence.stages import lacks_row, mean_rate
from lifelong.settings import plain_data
from lifelong.stats.metrics import lifelong_metrics
from tests.harness.configs import composed
from tests.harness.policies import small_transformer
from tests.harness.records import run_start
from tests.harness.sequences import (
    SPEC,
    TASKS,
    FakeEnv,
    Killed,
    Killer,
    assert_same,
    outcome,
    run_context,
    sequence,
)

pytestmark = pytest.mark.usefixtures("uncounted")
FROZEN = {"packnet": PackNet, "lora": lambda: LoRA(rank=2), "single_task": SingleTask}


class Camera(FakeEnv):
    """Counts the episodes that are run, by task."""

    episodes: list[int]

    def reset(self, **given):
        self.episodes += [self.task] * self.num_envs
        return super().reset(**given)


def learn(path, algorithm, *, policy=None, tasks=TASKS, env=Camera, held_out=0, **settings):
    """Learn the sequence; return its context and the tasks of the episodes that were run."""
    episodes = []
    env = type("Counted", (env,), {"episodes": episodes})
    context = run_context(path, "sequential", tasks)
    context = replace(
        context,
        languages=run_context(path, "sequential", tasks + held_out).languages,
        held_out=run_context(path, "sequential", tasks + held_out).tasks[tasks:],
        algorithm=algorithm,
        policy=policy or context.policy,
        envs=EnvPool(lambda key: env(*key), 2),
        eval=replace(context.eval, **settings),
    )
    if not context.directory.log.read().records:
        names, never = ([task.name for task in tasks] for tasks in (context.tasks, context.held_out))
        cells = {"cells": context.eval.cells, "cells_seed": context.eval.cells_seed}
        cells |= {"cells_share": context.eval.cells_share} if context.eval.cells == "sampled" else {}
        context.directory.log.append(run_start(names, held_out=never, **cells))
    sequence(context).run()
    return context, episodes


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that measures everything."""
    return learn(tmp_path_factory.mktemp("whole"), Sequential())[0]


def outcomes(context):
    """Return what each evaluation came to, by its key."""
    return {
        (r.phase, r.learned, r.task, r.epoch): r.outcome for r in context.directory.log.read().of(EvalRecord)
    }


@pytest.mark.parametrize("name", FROZEN)
def test_what_is_frozen_is_run_once_and_recorded_as_without_reuse(tmp_path, name):
    reusing, episodes = learn(tmp_path / "reusing", FROZEN[name](), curve="none", select="last")
    whole, all_episodes = learn(tmp_path / "whole", FROZEN[name](), curve="none", select="last", reuse=False)
    assert outcomes(reusing) == outcomes(whole)
    assert sorted(all_episodes) == [0] * 9 + [1] * 6 + [2] * 3  # three episodes a cell
    assert sorted(episodes) == [0] * 3 + [1] * 3 + [2] * 3
    results = reusing.directory.log.read()
    copies = [r for r in results.of(EvalRecord) if r.same_as]
    assert sorted((r.learned, r.task, r.same_as[:2], r.seconds) for r in copies) == [
        (row, task, ("matrix", task), 0.0) for row in range(TASKS) for task in range(row)
    ]
    assert results.episodes() == (9, 9) and summarize(results)["episodes"] == {"run": 9, "copied": 9}
    metrics = [lifelong_metrics(c.directory.log.read().scores()) for c in (reusing, whole)]
    np.testing.assert_equal(*(asdict(m) for m in metrics))


class Diverging(Camera):
    """The second simulation of the second task fails at once."""

    def step(self, actions):
        obs, rewards, terminated, truncated, info = super().step(actions)
        failed = (np.arange(self.num_envs) == 1) & (self.task == 1)
        errors = {1: "it has diverged"} if failed.any() else {}
        info |= {"success": info["success"] & ~failed, "errors": errors}
        return obs, rewards, terminated & ~failed, truncated | failed, info


def test_a_simulation_error_ends_neither_the_run_nor_other_episodes_and_is_told(tmp_path, capsys):
    context, _ = learn(tmp_path / "it", Sequential(), env=Diverging, curve="none", select="last")
    whole, _ = learn(tmp_path / "whole", Sequential(), curve="none", select="last")
    records = [c.directory.log.read().of(EvalRecord) for c in (context, whole)]
    for found, other in zip(*records, strict=True):
        if found.task != 1:
            assert found.outcome == other.outcome
            continue
        lost = found.simulation_errors[0][0]
        kept = tuple(s for s in other.init_states if s != lost)
        assert found.init_states == kept and len(found.lengths) == 2
        assert found.error_note == "1 of 3 ended by a simulation error, not counted"
    results = context.directory.log.read()
    assert results.success_matrix()[1].tolist() == [[3, 0, 0], [3, 2, 0], [3, 2, 3]]
    notes = results.error_notes
    assert len(notes) == 2 and notes[0] in capsys.readouterr().out, notes
    report = write_report([tmp_path / "it"], tmp_path / "report.html")
    assert notes[0] in report.read_text()
    errors = [one["simulation_errors"] for one in summarize(results)["evaluations"]]
    assert errors == [(), (), ((lost, "it has diverged"),), (), ((lost, "it has diverged"),), ()]


def test_the_last_point_of_a_curve_with_the_same_starts_is_the_cell_of_the_matrix(tmp_path):
    settings = {"selection": "reporting", "curve_episodes": 3, "record_every": 0, "select": "last"}
    context, _ = learn(tmp_path, Sequential(), **settings)
    diagonal = [r for r in context.directory.log.read().of(EvalRecord) if r.same_as]
    assert [(r.learned, r.task, r.same_as) for r in diagonal] == [(t, t, ("curve", t, 2)) for t in range(3)]


def test_rollouts_with_random_draws_are_run_again(tmp_path):
    with seeded(7):
        policy = small_transformer(SPEC, stochastic=True)
    context, _ = learn(tmp_path, SingleTask(), policy=policy, curve="none", select="last")
    results = context.directory.log.read()
    assert results.episodes() == (18, 0)
    assert not any(r.decided_by for r in results.of(EvalRecord))


class Shifted(SingleTask):
    """Acts with the weights of the task, and a number of its own that moves with every task."""

    moves = True

    def __init__(self):
        super().__init__()
        self.shift = 0.0

    def end_task(self, task_index, dataset, policy, generator):
        super().end_task(task_index, dataset, policy, generator)
        self.shift += self.moves

    def state_dict(self):
        return {"shift": self.shift}

    def load_state_dict(self, state, datasets):
        pass

    @contextmanager
    def policy_for(self, task_index, policy):
        with super().policy_for(task_index, policy) as acting:
            yield acting


class Still(Shifted):
    """The same, with a number that stays."""

    moves = False


def test_an_algorithm_that_says_nothing_is_known_by_its_whole_state(tmp_path):
    context, _ = learn(tmp_path / "moves", Shifted(), curve="none", select="last")
    assert context.directory.log.read().episodes() == (18, 0)
    context, _ = learn(tmp_path / "stays", Still(), curve="none", select="last")
    assert context.directory.log.read().episodes() == (9, 9)


def test_hooks_on_layers_are_not_overlooked():
    policy, algorithm = small_transformer(SPEC), Still()
    plain = Sequential()
    assert plain.acting_state(0, policy) == {}
    plain.state_dict = lambda: {"everything": 1}
    assert plain.acting_state(0, policy) == {}
    policy.head.register_forward_hook(lambda *_: None)
    assert plain.acting_state(0, policy) == {"everything": 1}
    assert algorithm.acting_state(0, policy) == {"shift": 0.0}


def test_the_digest_sees_every_tensor_and_circumstance():
    policy = small_transformer(SPEC)
    policy.register_buffer("hidden", torch.zeros(()), persistent=False)
    seen = {digest({"task": 0}, policy)}
    assert digest({"task": 0}, policy) in seen
    for tensor in (*policy.parameters(), *policy.buffers()):
        with torch.no_grad():
            tensor[(-1,) * tensor.dim()] += 1
        assert len(seen) < len(seen := seen | {digest({"task": 0}, policy)})
    for circumstances in ({"task": 1}, {"task": "0"}, {"task": [0]}, {"task": 0, "more": {}}):
        assert len(seen) < len(seen := seen | {digest(circumstances, policy)})


def test_a_lost_original_is_run_again_and_a_lost_copy_is_copied(tmp_path):
    context, _ = learn(tmp_path, SingleTask(), curve="none", select="last")
    before = outcomes(context)
    file = context.directory.log.path
    lines = file.read_text().splitlines(keepends=True)
    keys = [json.loads(line) for line in lines]
    for learned, run in ((0, 3), (2, 0)):
        key = ("eval", learned, 0)
        found = [tuple(map(k.get, ("kind", "learned", "task"))) for k in keys]
        lost = [line for line, one in zip(lines, found, strict=True) if one != key]
        assert len(lost) == len(lines) - 1
        file.write_text("".join(lost))
        again, episodes = learn(tmp_path, SingleTask(), curve="none", select="last")
        assert outcomes(again) == before and len(episodes) == run


def test_a_copy_that_is_not_what_it_is_a_copy_of_is_a_fault(tmp_path):
    context, _ = learn(tmp_path, SingleTask(), curve="none", select="last")
    log = context.directory.log
    assert not [f for f in examine(tmp_path).findings if "copy of" in f.text]
    copy = next(r for r in log.read().of(EvalRecord) if r.same_as)
    log.append(replace(copy, lengths=tuple(n + 1 for n in copy.lengths)))
    assert [f.text for f in examine(tmp_path).findings if "is not what it is a copy of" in f.text]


def test_videos_of_the_last_row_are_copied_and_measured_again_without_them(tmp_path):
    context, _ = learn(tmp_path / "a", SingleTask(), tasks=2, curve="none", select="last")
    names = {p.name for p in context.directory.videos.iterdir()}
    cells = ((0, 0), (0, 1), (1, 1))
    assert names == {f"task_0{t}_after_0{r}.{e}" for t, r in cells for e in ("txt", "webp")}
    first, last = (context.directory.videos / f"task_00_after_0{r}.webp" for r in (0, 1))
    assert first.read_bytes() == last.read_bytes()
    assert "after learning 2 tasks" in last.with_suffix(".txt").read_text()


@pytest.mark.parametrize(("cells", "measured", "defined"), [
    ("diagonal", [(0, 0), (1, 1), (2, 2)], {"fwt", "just_learned"}),
    ("last_row", [(2, 0), (2, 1), (2, 2)], {"fwt", "final_success"}),
    ("diagonal_and_last_row", [(0, 0), (1, 1), (2, 0), (2, 1), (2, 2)], {"fwt", "final_success", "just_learned"}),
    ("sampled", [*np.ndindex(3, 3)], {"fwt", "nbt", "auc", "final_success", "just_learned"}),
])  # fmt: skip
def test_only_the_cells_that_are_asked_for_are_measured(tmp_path, whole, cells, measured, defined, capsys):
    context, _ = learn(tmp_path / "some", Sequential(), cells=cells)
    measured = [cell for cell in measured if cell[1] <= cell[0]]  # of a row of two, one tenth is one
    expected = {k: v for k, v in outcomes(whole).items() if k[0] == "curve" or k[1:3] in measured}
    assert outcomes(context) == expected
    results = context.directory.log.read()
    assert results.learned_tasks() == TASKS and is_measured(context, results)
    found, of_whole = (lifelong_metrics(c.directory.log.read().scores()) for c in (context, whole))
    names = ("fwt", "nbt", "auc", "final_success", "just_learned")
    assert {name for name in names if not np.isnan(getattr(found, name).value)} == defined
    for name in defined:
        assert getattr(found, name) == getattr(of_whole, name)
    ((_, table),) = read_episodes(write_episodes(tmp_path / "episodes.csv", [("sequential", results)]))
    of_table = lifelong_metrics(table.scores())
    assert {name for name in names if not np.isnan(getattr(of_table, name).value)} == defined
    for name in defined:
        assert getattr(of_table, name) == getattr(found, name)
    assert not [f for f in examine(tmp_path / "some").findings if "lacks" in f.text]
    assert sum(results.episodes()) == 3 * len(measured) + 18
    assert f"{results.episodes()[0]} episodes were run" in write_report([tmp_path / "some"]).read_text()
    _, again = learn(tmp_path / "some", Sequential(), cells=cells)
    assert again == [] and "nan" not in capsys.readouterr().out


def test_each_seed_samples_cells_of_its_own_and_every_reader_finds_them(tmp_path):
    """Records without a seed are of the one drawing that all runs had in common."""
    of_old = {1: [0], 2: [1], 3: [2], 4: [2, 3], 5: [2, 4], 6: [2, 3], 7: [3, 4, 6], 8: [1, 2, 4]}
    assert {row: sampled_tasks(row, 0.3, None) for row in of_old} == of_old
    settings = {"cells": "sampled", "cells_share": 0.3, "curve": "none", "select": "last"}
    tasks, found = 5, {}
    for seed in (None, 1, 2, 3):
        where = tmp_path / str(seed)
        context, _ = learn(where, Sequential(), tasks=tasks, cells_seed=seed, **settings)
        results = context.directory.log.read()
        found[seed] = {(r.learned, r.task) for r in results.of(EvalRecord)}
        assert found[seed] == {(row, seen) for row in range(tasks) for seen in results.run.row([row])}
        assert results.learned_tasks() == tasks and is_measured(context, results)
        assert not [f for f in examine(where).findings if "lacks" in f.text]
        ((_, table),) = read_episodes(write_episodes(tmp_path / "e.csv", [("sequential", results)]))
        assert table.run.row([3]) == results.run.row([3]) and table.learned_tasks() == tasks
        assert learn(where, Sequential(), tasks=tasks, cells_seed=seed, **settings)[1] == []  # nothing anew
    assert len(set(map(frozenset, found.values()))) > 2


@pytest.mark.parametrize(("words", "seed"), [
    (["eval.cells=sampled"], 5), (["eval.cells=sampled", "eval.cells_seed=0"], 0), ([], None),
])  # fmt: skip
def test_a_run_samples_its_cells_by_its_own_seed_unless_it_is_told(words, seed):
    config = with_chosen(plain_data(composed("seed=5", *words)))
    assert config["eval"]["cells_seed"] == seed and with_chosen(config) == config


def test_trackers_are_told_the_mean_over_all_tasks_or_none(tmp_path):
    told = []
    context = run_context(tmp_path, Sequential)
    settings = replace(context.eval, cells="diagonal_and_last_row", curve="none", select="last")
    tracker = SimpleNamespace(log=lambda values, step: told.append(values))
    sequence(replace(context, eval=settings, tracker=tracker)).run()
    after = [values for values in told if "success/just_learned" in values]
    assert ["success/mean" in values for values in after] == [True, False, True]


def test_a_curve_without_its_start_and_no_curve():
    assert EvalSettings(every=5).curve_epochs(12) == (0, 5, 10, 12)
    assert EvalSettings(every=5, curve="trained").curve_epochs(12) == (5, 10, 12)
    assert EvalSettings(every=50, curve="trained").curve_epochs(12) == (12,)
    assert EvalSettings(every=5, curve="none", select="last").curve_epochs(12) == ()
    with pytest.raises(ConfigError, match=r"eval\.select=best needs a learning curve"):
        EvalSettings(curve="none")


def test_rows_go_there_and_back_so_that_open_environments_are_used_again(tmp_path):
    context, _ = learn(tmp_path / "half", Sequential(), curve="none", select="last")
    built = []
    context = replace(context, directory=RunDirectory(tmp_path / "run"), algorithm=Sequential())
    sequence(replace(context, envs=EnvPool(lambda key: built.append(key) or FakeEnv(*key), TASKS - 1))).run()
    assert len(built) == TASKS + 1  # one task too many for the pool, in the last row alone


class _Ends(Sequential):
    """Fails when the last task begins, while what came before is still measured."""

    def begin_task(self, task_index, dataset, policy):
        if task_index == TASKS - 1:
            raise RuntimeError("ended here")


@pytest.mark.parametrize("interrupted", [False, True])
def test_rows_beside_training_are_measured_in_another_process_and_recorded_alike(
    tmp_path, whole, interrupted, monkeypatch
):
    """Those of the last row in both; what was not recorded when a run ended is measured when it goes on."""
    monkeypatch.setattr("lifelong.context.cpu_count", lambda: 2)
    if interrupted:
        with pytest.raises(RuntimeError, match="ended here"):
            learn(tmp_path, _Ends(), beside=True)
        assert lacks_row(run_context(tmp_path, "sequential"), (1,), RunDirectory(tmp_path).log.read())
    context, episodes = learn(tmp_path, Sequential(), beside=True)
    assert outcomes(context) == outcomes(whole)
    ends = [outcome(one.directory.path, one.directory.log)[1] for one in (context, whole)]
    assert_same(*ends)
    assert videos(context) == videos(whole)
    points = 0 if interrupted else (TASKS - 1) * 3 * 2  # of the curves of the first tasks, two episodes each
    assert len(episodes) == points + 3 * 2 + 3 * (TASKS // 2)


def test_what_another_process_cannot_have_is_measured_in_this_one(tmp_path, whole, monkeypatch):
    monkeypatch.setattr("lifelong.context.cpu_count", lambda: 2)
    policy = run_context(tmp_path, "sequential").policy
    policy.head.register_forward_hook(lambda *_: None)
    context, episodes = learn(tmp_path, Sequential(), policy=policy, beside=True)
    assert outcomes(context) == outcomes(whole)
    records = context.directory.log.read().of(EvalRecord)
    assert len(episodes) == sum(len(r.successes) for r in records if not r.same_as)


def videos(context):
    return {path.name: path.read_bytes() for path in context.directory.videos.iterdir()}


@pytest.mark.parametrize(("select", "kept"), [("best", 2), ("first_best", 0)])
def test_where_nothing_succeeds_the_kept_weights_are_named(tmp_path, monkeypatch, capsys, select, kept):
    monkeypatch.setattr(EvalRecord, "rate", 0.0)
    context, _ = learn(tmp_path, Sequential(), tasks=1, select=select)
    assert context.directory.log.read().task_end(0).best_epoch == kept
    whose = "from before the task" if kept == 0 else "of epoch 2, the last of 3 equal ones,"
    assert f"no rollout has succeeded at any epoch: the weights {whose} are kept" in capsys.readouterr().out


def test_forward_transfer_without_epoch_0_is_the_mean_of_the_others(tmp_path):
    context, _ = learn(tmp_path, Sequential(), curve="trained", select="last")
    results = context.directory.log.read()
    assert {tuple(curve.epochs) for curve in results.curves().values()} == {(1, 2)}
    held = [curve.held().mean() for curve in results.curves().values()]
    assert lifelong_metrics(results.scores(transfer="published")).fwt.value == pytest.approx(np.mean(held))


@pytest.mark.parametrize("algorithm", [Sequential, PackNet])
def test_training_ends_where_success_is_enough(tmp_path, monkeypatch, algorithm):
    """Also where it was killed and goes on, to the same bits."""
    settings = {"curve": "all", "select": "last", "until": (0.0, 0.9, 0.5)}
    monkeypatch.setattr(EvalRecord, "rate", property(lambda record: (0.0, 0.5, 1.0)[record.epoch]))
    context, _ = learn(tmp_path / "whole", algorithm(), **settings)
    results = context.directory.log.read()
    curves = {task: [*curve.epochs] for task, curve in results.curves().items()}
    assert curves == {0: [0], 1: [0, 1, 2], 2: [0, 1]}
    if algorithm is Sequential:
        assert [results.task_end(task).best_epoch for task in range(TASKS)] == [0, 2, 1]
        assert [results.costs(task)["updates"] for task in range(TASKS)] == [0, 6, 3]
    (tmp_path / "whole" / "config.yaml").write_text("eval: {until: 0.5}")
    assert not [found.text for found in examine(tmp_path / "whole").findings if "lacks" in found.text]
    for writes in (4, 11, 19):
        path = tmp_path / str(writes)
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(ResultLog, "append", Killer(patch, writes).guard(ResultLog.append))
            learn(path, algorithm(), **settings)
        again, _ = learn(path, algorithm(), **settings)
        (records, state), (expected, last) = (
            outcome(c.directory.path, c.directory.log) for c in (again, context)
        )
        assert records == expected
        assert_same(state, last)


@pytest.mark.parametrize("unseen", ["next", "all"])
def test_tasks_to_come_are_evaluated_on_request(tmp_path, unseen):
    context, episodes = learn(tmp_path, Sequential(), unseen=unseen, curve="none", select="last", reuse=False)
    records = context.directory.log.read()
    rates = {(r.phase, r.learned, r.task): r.rate for r in records.of(EvalRecord)}
    expected = {"next": {(0, 1), (1, 2)}, "all": {(0, 1), (0, 2), (1, 2)}}[unseen]
    assert {key[1:] for key in rates if key[0] == "unseen"} == expected
    assert {key[1:] for key in rates if key[0] == "initial"} == {(0, task) for task in range(TASKS)}
    assert len(episodes) == 3 * (TASKS + len(expected) + 6)
    found = summarize(records)["metrics_of_other_conventions"]
    gains = [rates["unseen", k - 1, k] - rates["initial", 0, k] for k in (1, 2)]
    assert found["fwt_of_gem"] == pytest.approx(np.mean(gains))
    assert found["zero_shot_next"] == pytest.approx(np.mean([rates["unseen", k - 1, k] for k in (1, 2)]))
    above = np.mean([rates[key] for key in rates if key[0] == "unseen"]) if unseen == "all" else np.nan
    assert found["zero_shot"] == pytest.approx(above, nan_ok=True)
    assert {r.phase for r in records.evaluations()} == {"matrix"}  # no metric or table has others
    again, more = learn(tmp_path, Sequential(), unseen=unseen, curve="none", select="last", reuse=False)
    assert more == [] and again.directory.log.read().records == records.records


@pytest.mark.parametrize("algorithm", [Sequential, *FROZEN.values()])
def test_tasks_that_are_never_learned_are_evaluated_before_and_after_the_others(tmp_path, algorithm):
    settings = {"held_out": 2, "curve": "none", "select": "last", "cells": "diagonal", "reuse": False}
    context, episodes = learn(tmp_path, algorithm(), **settings)
    records = context.directory.log.read()
    held = {(r.phase, r.learned, r.task): r.rate for r in records.of(EvalRecord) if r.phase != "matrix"}
    assert set(held) == {
        (*when, TASKS + k) for when in [("initial", 0), ("unseen", TASKS - 1)] for k in (0, 1)
    }
    found = summarize(records)["metrics_of_other_conventions"]
    for name, phase in (("held_out_before", "initial"), ("held_out_after", "unseen")):
        assert found[name] == pytest.approx(np.mean([rate for key, rate in held.items() if key[0] == phase]))
    assert np.isnan(found["zero_shot"]) and records.success_matrix()[0].shape == (TASKS, TASKS)
    log = tmp_path / "results.jsonl"
    log.write_bytes(b"".join(line for line in log.read_bytes().splitlines(True) if b'"unseen"' not in line))
    assert np.isnan(ResultLog(log).read().other_conventions()["held_out_after"]), (
        "of a part it is another number"
    )
    again, more = learn(tmp_path, algorithm(), **settings)
    assert more == [TASKS] * 3 + [TASKS + 1] * 3
    assert outcomes(again) == {
        (r.phase, r.learned, r.task, r.epoch): r.outcome for r in records.of(EvalRecord)
    }


def test_a_lost_evaluation_before_the_only_task_is_measured_again(tmp_path):
    settings = {"tasks": 1, "held_out": 1, "reuse": False}
    context, _ = learn(tmp_path, Sequential(), **settings)
    log, whole = tmp_path / "results.jsonl", outcomes(context)
    log.write_bytes(b"".join(line for line in log.read_bytes().splitlines(True) if b'"initial"' not in line))
    again, _ = learn(tmp_path, Sequential(), **settings)
    assert outcomes(again) == whole


def test_equal_success_of_several_tasks_is_equal():
    rates = [SimpleNamespace(rate=rate) for rate in (0.1, 0.7, 0.2, 0.7, 0.7, 0.7)]
    assert mean_rate(rates[:3]) == mean_rate([rates[2], rates[0], rates[1]])
    assert mean_rate(rates[3:]) == 0.7 == EvalSettings(until=(0.7,) * 3, select="last").enough((0, 1, 2))


@pytest.mark.parametrize(("phase", "key", "ran"), [("unseen", (0, 2), 3), ("initial", (0, 1), 3)])
def test_a_lost_evaluation_of_a_task_to_come_is_measured_again(tmp_path, phase, key, ran):
    settings = {"unseen": "all", "curve": "none", "select": "last", "reuse": False}
    context, _ = learn(tmp_path, Sequential(), **settings)
    log = tmp_path / "results.jsonl"
    whole, lines = ResultLog(log).read(), log.read_bytes().splitlines(keepends=True)
    lost = [line for line in lines if f'"{phase}"'.encode() in line][1]
    log.write_bytes(b"".join(line for line in lines if line != lost))
    assert not is_measured(context, ResultLog(log).read())
    _, again = learn(tmp_path, Sequential(), **settings)
    assert again == [key[1]] * ran
    assert ResultLog(log).read().evaluation(phase, *key).outcome == whole.evaluation(phase, *key).outcome


def test_an_error_in_training_does_not_wait_for_rollouts_beside_it():
    with pytest.raises(TrainingError), RolloutProcess(EnvPool(lambda key: FakeEnv(key, 1))) as process:
        process._pool = spawn_pool(1)
        rollouts = process._pool.submit(time.sleep, 3600)
        while not rollouts.running():
            time.sleep(0.01)
        raise TrainingError("the loss is not finite")
    assert isinstance(rollouts.exception(), BrokenExecutor), "it was killed"
