"""Streams: groups of tasks, fewer demonstrations, blurred boundaries, pretraining and initial weights."""

import math
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from libero_env.tasks import get_suite
from lifelong import checkpoints, experiment, run_demonstrations
from lifelong.algorithms import ER, DERpp, Multitask, Sequential, SingleTask
from lifelong.context import RunContext
from lifelong.data.memory import ReplayMemory
from lifelong.errors import CheckpointError, ConfigError, DataError, LiberoError
from lifelong.pretraining import initial_policy, load_initial_weights, policy_at_start, pretraining_context
from lifelong.report.page import write_report
from lifelong.results.log import ResultLog
from lifelong.results.provenance import utc_now
from lifelong.results.records import DemonstrationsRecord, EvalRecord, LossRecord, RunEndRecord, TaskEndRecord
from lifelong.results.run_directory import RunDirectory
from lifelong.sequence import TaskSequence
from lifelong.settings import BenchmarkSettings, Configuration, PretrainSettings, plain_data
from lifelong.stats.metrics import lifelong_metrics
from lifelong.streams import StageData, StageWindows, StreamSettings, learning_stages, plan_tasks
from lifelong.training.distributed import Ranks
from tests.harness.algorithms import assert_resumed_equals_uninterrupted
from tests.harness.configs import composed
from tests.harness.fakes import Windows
from tests.harness.records import evaluation, run_start
from tests.harness.runs import TINY, make_run
from tests.harness.sequences import Killed, Killer, assert_same, dataset, run_context, sequence

pytestmark = pytest.mark.usefixtures("uncounted")


def stage_data(
    blur: float, *, sizes=(20, 30, 25, 40), group_size: int = 1, reach: int = 1, seed: int = 0
) -> StageData:
    datasets = {task: Windows(task, size) for task, size in enumerate(sizes)}
    stages = learning_stages(Sequential(), StreamSettings().group_sizes(len(sizes), group_size))
    return StageData(datasets, stages, StreamSettings(blur=blur, blur_reach=reach), seed)


def contents(windows) -> torch.Tensor:
    """Return the (W, D) contents of the windows."""
    return windows.batch(torch.arange(len(windows))).observation.proprio["x"][:, 0]


def rows(features: torch.Tensor) -> set[tuple[float, ...]]:
    return {tuple(row) for row in features.tolist()}


def test_groups_are_consecutive_and_algorithms_join_groups() -> None:
    assert learning_stages(Sequential(), (1, 1, 1)) == ((0,), (1,), (2,))
    assert learning_stages(Sequential(), (2, 2, 2)) == ((0, 1), (2, 3), (4, 5))
    assert learning_stages(Sequential(), (3, 1, 2)) == ((0, 1, 2), (3,), (4, 5))
    assert learning_stages(Multitask(), (3, 1, 2)) == ((0, 1, 2, 3, 4, 5),)


@pytest.mark.parametrize(
    ("base", "group_size", "expected"),
    [(None, 1, (1,) * 10), (None, 5, (5, 5)), (6, 1, (6, 1, 1, 1, 1)), (4, 3, (4, 3, 3)), (10, 1, (10,))],
)
def test_the_base_stage_comes_before_groups_of_the_rest(base, group_size, expected) -> None:
    assert StreamSettings(base_tasks=base).group_sizes(10, group_size) == expected


def test_by_default_a_stage_is_the_task_itself() -> None:
    data = stage_data(0.0)
    assert list(data) == [0, 1, 2, 3]
    assert all(data[task] is data.datasets[task] for task in data)
    with pytest.raises(KeyError):
        data[4]


def test_a_group_has_the_requested_windows_in_order_with_the_id_of_its_last_task() -> None:
    data = stage_data(0.0, group_size=2)
    assert list(data) == [1, 3]
    group = data[3]
    assert len(group) == 65
    wanted = torch.tensor([64, 3, 25, 0, 24, 25])
    batch, two = group.batch(wanted), (data.datasets[2], data.datasets[3])
    assert torch.equal(batch.window_ids, wanted) and (batch.task_ids == 3).all()
    found = batch.observation.proprio["x"][:, 0]
    assert torch.equal(found, torch.cat([one.features for one in two])[wanted])
    assert torch.equal(batch.actions[:, 0], torch.cat([one.targets for one in two])[wanted])


@pytest.mark.parametrize("reach", [1, 2, 9])
@pytest.mark.parametrize("group_size", [1, 2])
def test_with_blurred_boundaries_every_window_is_learned_once(group_size: int, reach: int) -> None:
    data = stage_data(0.3, group_size=group_size, reach=reach)
    learned = [contents(data[last]) for last in data]
    everything = torch.cat([d.features for d in data.datasets.values()])
    assert sum(map(len, learned)) == len(everything)
    assert rows(torch.cat(learned)) == rows(everything)


def test_the_blurred_share_is_divided_evenly_over_the_neighbours() -> None:
    data, sizes = stage_data(0.3), (20, 30, 25, 40)
    own = {task: rows(windows.features) for task, windows in data.datasets.items()}
    found = {
        (task, stage): len(own[task] & rows(contents(data[stage]))) for task in range(4) for stage in range(4)
    }
    for task, size in enumerate(sizes):
        assert found[task, task] == size - round(0.3 * size)
        away = [found[task, stage] for stage in (task - 1, task + 1) if 0 <= stage < 4]
        assert sum(away) == round(0.3 * size) and max(away) - min(away) <= 1
        assert all(not found[task, stage] for stage in range(4) if abs(stage - task) > 1)


def test_only_the_seed_determines_the_blurred_windows() -> None:
    def draw(seed: int) -> torch.Tensor:
        return contents(stage_data(0.3, seed=seed)[1])

    state = torch.random.get_rng_state()
    assert torch.equal(draw(0), draw(0))
    assert rows(draw(0)) != rows(draw(1))
    assert torch.equal(torch.random.get_rng_state(), state)


def test_a_replay_memory_of_stages_reloads_by_window_ids() -> None:
    data = stage_data(0.3, group_size=2)
    memory, draws = ER(memory=ReplayMemory(30)).memory, torch.Generator().manual_seed(0)
    for last in data:
        memory.add(data[last], draws)
    batch = memory.sample(30, draws)
    assert set(batch.task_ids.tolist()) == {1, 3}
    for task, window, seen in zip(
        batch.task_ids.tolist(), batch.window_ids, batch.observation.proprio["x"], strict=True
    ):
        assert torch.equal(data[task].batch(window[None]).observation.proprio["x"][0], seen)


@pytest.mark.parametrize(("later", "expected"), [
    (None, (50, 50, 50)), (5, (50, 5, 5)), (1, (50, 1, 1)), (0.1, (50, 5, 5)), (1.0, (50, 50, 50)),
    (0.001, (50, 1, 1)), ([10, 3], (50, 10, 3))
])  # fmt: skip
def test_demonstrations_of_later_tasks(later, expected) -> None:
    assert StreamSettings(demos_later=later).demos(50, 3) == expected
    of_last = later[:1] if isinstance(later, list) else later
    assert StreamSettings(demos_later=of_last).demos(50, 3, first=2)[:2] == (50, 50)


@pytest.mark.parametrize("later", [0, -1, 1.5, 0.0, [1], [1, 0], [1, 0.5], "many"])
def test_invalid_numbers_of_demonstrations_are_refused(later) -> None:
    with pytest.raises(LiberoError, match="demos_later"):
        StreamSettings(demos_later=later).demos(50, 3)


@pytest.mark.parametrize(("words", "told"), [
    (["benchmark.tasks=1", "stream=shift"], "stream.perturb has no effect on one group"),
    (["algo=multitask", "stream.blur=0.9"], "stream.blur has no effect on one stage"),
    (["algo=lora", "algo.base_tasks=2"], "algo.base_tasks is 2; of 2 stages none would be left"),
    (["language=onehot", "stream=shift_instruction"], "stream.perturb changes instructions"),
    (["language.numbered=true", "stream=shift_instruction"], "stream.perturb changes instructions"),
    (["language=onehot", "eval.held_out=libero_goal"], "eval.held_out has tasks"),
])  # fmt: skip
def test_a_stream_without_effect_is_refused(words, told) -> None:
    tasks = [] if "benchmark.tasks=1" in words else ["benchmark.tasks=2"]
    with pytest.raises(ConfigError, match=told):
        plan_tasks(Configuration(plain_data(composed(*words, *tasks))))


def test_group_sizes_must_divide_the_number_of_tasks() -> None:
    with pytest.raises(ConfigError, match=r"10 tasks can be learned in groups of 1, 2, 5, 10"):
        StreamSettings().group_sizes(10, 3)
    with pytest.raises(ConfigError, match=r"4 tasks after stream.base_tasks=6 can be .* groups of 1, 2, 4"):
        StreamSettings(base_tasks=6).group_sizes(10, 3)
    with pytest.raises(ConfigError, match=r"stream.base_tasks is 6; .* 3 tasks, of which 1 to 3"):
        StreamSettings(base_tasks=6).group_sizes(3)
    with pytest.raises(LiberoError, match="greater than or equal to 1"):
        BenchmarkSettings("libero_goal", tasks=4, group_size=0).sequence()


def test_pretraining_takes_a_suite_or_nothing() -> None:
    assert PretrainSettings().sequence() == ()
    assert [t.suite for t in PretrainSettings("libero_90", tasks=2).sequence()] == ["libero_90"] * 2
    for settings, told in (
        ({"suite": "libero_9"}, "libero_90"),
        ({"suite": "own"}, "unknown suite 'own'"),
        ({"suite": "libero_goal", "tasks": 99}, "pretrain.tasks is 99; libero_goal has 10 tasks"),
        ({"epochs": 0}, "epochs is 0"),
        *(({key: 3}, f"pretrain.{key} has no effect without") for key in ("tasks", "demos", "epochs")),
    ):
        with pytest.raises(LiberoError, match=told):
            PretrainSettings(**settings).sequence()


def four(path: Path, algorithm, **changes) -> RunContext:
    """Four tasks in groups of two, of one epoch each."""
    context = run_context(path, "sequential", tasks=4)
    if not context.directory.log.read().records:
        context.directory.log.append(run_start("abcd", group_sizes=changes.get("group_sizes", (2, 2))))
    fit = replace(context.fit, epochs=1, steps_per_epoch=2)
    return replace(context, algorithm=algorithm, fit=fit, **({"group_sizes": (2, 2)} | changes))


@pytest.mark.parametrize("algorithm", [lambda: DERpp(budget=12), SingleTask])
def test_groups_are_learned_evaluated_and_resumed(tmp_path, monkeypatch, algorithm) -> None:
    blurred = {"stream": StreamSettings(blur=0.2)}
    make = lambda path, algorithm: four(path, algorithm(), **blurred)  # noqa: E731
    assert_resumed_equals_uninterrupted(tmp_path, algorithm, monkeypatch, make, last=3)
    results = ResultLog(tmp_path / "whole" / "results.jsonl").read()
    evals = results.of(EvalRecord)
    assert {(r.learned, r.task) for r in evals if r.phase == "matrix"} == {
        (1, 0), (1, 1), (3, 0), (3, 1), (3, 2), (3, 3)
    }  # fmt: skip
    groups = ((1, 0), (1, 1), (3, 2), (3, 3))
    learned = {(r.learned, r.task, r.epoch) for r in evals if r.phase == "curve"}
    assert learned == {(*of_group, epoch) for of_group in groups for epoch in (0, 1)}
    assert [r.task for r in results.of(TaskEndRecord)] == [1, 3]
    filmed = {path.stem for path in (tmp_path / "whole" / "videos").glob("*.webp")}
    assert filmed == {f"task_0{task}_after_0{last}" for last, task in (*groups, (3, 0), (3, 1))}


def test_a_policy_meets_each_of_the_tasks_that_are_learned_together(tmp_path) -> None:
    """A policy that reads texts knows them by the embeddings in the windows."""
    context, met = four(tmp_path, Sequential()), {}
    embedding = lambda windows: tuple(windows.batch(torch.tensor([0])).observation.language[0].tolist())  # noqa: E731
    context.policy.meet_task = lambda windows, text: met.setdefault(embedding(windows), text)
    sequence(context).run()
    texts = zip(context.languages, context.instructions, strict=True)
    assert met == {tuple(language.tolist()): text for language, text in texts}


def test_metrics_count_a_group_as_one_task(tmp_path) -> None:
    log = ResultLog(tmp_path / "results.jsonl")
    log.append(run_start("abcd", group_sizes=(2, 2)))

    def evaluated(phase: str, learned: int, epoch: int, rates: dict[int, float]) -> None:
        for task, rate in rates.items():
            log.append(evaluation(phase, learned, epoch, task, round(10 * rate), 10))

    evaluated("curve", 1, 0, {0: 0.0, 1: 0.0})
    evaluated("curve", 1, 5, {0: 0.6, 1: 0.8})  # the best of the group: 0.7
    evaluated("curve", 1, 10, {0: 0.2, 1: 1.0})
    evaluated("matrix", 1, 5, {0: 0.5, 1: 0.9})
    log.append(TaskEndRecord(task=1, best_epoch=5, seconds=1.0))
    assert log.read().learned_tasks() == 2
    evaluated("curve", 3, 0, {2: 0.0, 3: 0.2})
    evaluated("curve", 3, 5, {2: 0.4, 3: 0.6})
    evaluated("matrix", 3, 5, {0: 0.1, 1: 0.5, 2: 0.4, 3: 0.8})
    assert log.read().learned_tasks() == 4
    results = log.read()
    found = lifelong_metrics(results.scores())
    fwt = ((0.0 + 0.7 + 0.7) / 3, (0.1 + 0.5) / 2)
    np.testing.assert_allclose(found.fwt_by_task, np.repeat(fwt, 2))
    np.testing.assert_allclose(found.nbt_by_task, [0.4, 0.4, 0, 0])
    assert math.isclose(found.nbt.value, 0.2)
    assert math.isclose(found.auc.value, ((fwt[0] + 0.3) / 2 + fwt[1]) / 2)
    assert math.isclose(found.final_success.value, (0.1 + 0.5 + 0.4 + 0.8) / 4)
    assert math.isclose(found.just_learned.value, (0.7 + 0.6) / 2)
    assert found.final_success.low < found.final_success.value < found.final_success.high
    curve = results.success_matrix("curve")[0]  # of the group's best epoch, not of each task's own
    np.testing.assert_allclose(curve[1, :2], [0.6, 0.8])
    assert np.isnan(curve[0]).all() and np.isnan(curve[2]).all()
    assert set(results.curves()) == {0, 1, 2, 3}
    assert write_report([tmp_path]).stat().st_size > 10_000


def before(context: RunContext, path: Path) -> None:
    """Learn two other tasks first."""
    pretraining = pretraining_context(
        context,
        tasks=get_suite("libero_goal").tasks[:2],
        languages=torch.stack([dataset(task).language for task in (7, 8)]),
        settings=PretrainSettings("libero_90", epochs=2),
        directory=RunDirectory(path),
    )
    sequence(pretraining, first=7).run(evaluate=False)


def test_pretraining_is_joint_without_evaluation_and_done_once(tmp_path, monkeypatch) -> None:
    first, second, third = (run_context(tmp_path / name, "sequential") for name in "abc")
    untrained = {k: v.clone() for k, v in first.policy.state_dict().items()}
    before(first, tmp_path / "whole")
    results = RunDirectory(tmp_path / "whole").log.read()
    assert {r.epoch for r in results.of(LossRecord)} == {1, 2} and not results.of(EvalRecord)
    trained = first.policy.state_dict()
    assert any(not torch.equal(untrained[k], v) for k, v in trained.items())
    assert len(StageWindows([dataset(7), dataset(8)], 1)) == 40
    with monkeypatch.context() as patch:
        Killer(patch, 2)
        with pytest.raises(Killed):
            before(second, tmp_path / "killed")
    before(third, tmp_path / "killed")
    assert_same(dict(third.policy.state_dict()), dict(trained))
    monkeypatch.setattr(TaskSequence, "_learn_stage", lambda *_: pytest.fail("done already"))
    again = run_context(tmp_path / "d", "sequential")
    before(again, tmp_path / "whole")
    assert_same(dict(again.policy.state_dict()), dict(trained))


def test_a_policy_may_start_from_a_finished_runs_weights(tmp_path) -> None:
    run = RunDirectory(tmp_path / "run")
    for task in (0, 1, 10):
        state = {"task": task, "policy": {"w": torch.full((2,), float(task))}, "algorithm": {}}
        checkpoints.save(run.checkpoints.task_path(task), state)
    run.log.append(LossRecord(task=0, epoch=1, loss=1.0, seconds=1.0))
    with pytest.raises(CheckpointError, match=r"not finished.*init_from=.*task_10\.safetensors"):
        load_initial_weights(run.path)
    run.log.append(RunEndRecord(seconds=1.0, finished=utc_now()))
    weights, file = load_initial_weights(run.path)
    assert weights["w"].tolist() == [10.0, 10.0] and file == run.checkpoints.task_path(10)
    assert load_initial_weights(run.checkpoints.task_path(1))[0]["w"].tolist() == [1.0, 1.0]


def test_paths_without_weights_are_refused(tmp_path) -> None:
    with pytest.raises(CheckpointError, match=r"not a run directory, or no task is learned yet"):
        load_initial_weights(tmp_path)
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        load_initial_weights(tmp_path / "absent")
    progress = RunDirectory(tmp_path).checkpoints.progress_path
    checkpoints.save(progress, {"task": 0, "policy": None, "fit": {}})
    with pytest.raises(CheckpointError, match="holds no policy's weights"):
        load_initial_weights(progress)
    routed = RunDirectory(tmp_path).checkpoints.task_path(0)
    for library in ({}, {1: {"layer": {}}}):  # of the base stage, and with experts after it
        checkpoints.save(routed, {"task": 0, "policy": {}, "algorithm": {"library": library}})
        if not library:
            load_initial_weights(routed)
    with pytest.raises(CheckpointError, match="acts with experts beside these weights"):
        load_initial_weights(routed)


def test_single_task_starts_each_task_from_the_pretrained_weights(tmp_path) -> None:
    p = run_context(tmp_path, "sequential")
    p = replace(p, algorithm=SingleTask(), fit=replace(p.fit, epochs=1, steps_per_epoch=1))
    before(p, tmp_path / "first")
    trained = {k: v.clone() for k, v in p.policy.state_dict().items()}
    sequence(p).run()
    initial = checkpoints.load(p.directory.checkpoints.task_path(2))["algorithm"]["initial"]
    assert_same(dict(initial), trained)


def test_orders_by_seed_hold_the_same_tasks():
    published = BenchmarkSettings("libero_10", tasks=6).sequence()
    orders = [BenchmarkSettings("libero_10", tasks=6, order_seed=seed).sequence() for seed in (0, 1, 0)]
    assert orders[0] == orders[2] != orders[1] and {*orders[0]} == {*orders[1]} == {*published}
    assert len({*BenchmarkSettings("libero_130", order_seed=7).sequence()}) == 130
    for other, told in (({"order_seed": 1}, "order_seed 1; give one"), ({"tasks": (0, 1)}, "tasks a list")):
        with pytest.raises(ConfigError, match=f"benchmark.order is 3 and benchmark.{told}"):
            BenchmarkSettings("libero_10", order=3, **other).sequence()


@pytest.mark.parametrize("word", [
    "language.numbered=true", "language.model=bert", "data.views=[eye_in_hand_rgb,agentview_rgb]",
    "data.proprio=[ee_pos,gripper_states,joint_states]", "policy.encoder.pixels=libero",
    "policy.normalise_proprio=false", "policy.standardise_language=false", "policy.encoder.temperature=0.2",
    "policy.encoder.stem_pool=true", "policy.temporal.heads=8"
])  # fmt: skip
def test_weights_that_were_learned_with_other_inputs_of_the_same_shapes_are_refused(tmp_path, word) -> None:
    run = RunDirectory(tmp_path / "run")
    config = Configuration(plain_data(composed(*TINY)))
    spec = config.build("data").spec(4)
    policy = policy_at_start(config, spec, 1, None)
    checkpoints.save(
        run.checkpoints.task_path(0), {"task": 0, "policy": policy.state_dict(), "algorithm": {}}
    )
    (run.path / "config.yaml").write_text(yaml.safe_dump(dict(config.values)))
    policy_at_start(config, spec, 2, run.checkpoints.task_path(0))
    other = Configuration(plain_data(composed(*TINY, word)))
    with pytest.raises(CheckpointError, match=f"learned with {word.partition('=')[0]}="):
        policy_at_start(other, spec, 1, run.checkpoints.task_path(0))


def test_a_run_that_was_pretrained_did_not_begin_with_the_weights_that_the_pretraining_began_with(
    tmp_path,
) -> None:
    words = ("pretrain.suite=libero_goal", "pretrain.tasks=1", f"init_from={tmp_path}/other")
    make_run(tmp_path / "run", *words)
    with pytest.raises(ConfigError, match="began with pretrained weights; name them with --initial"):
        initial_policy(tmp_path / "run")


@pytest.mark.parametrize(("language", "other", "shared"), [
    ("onehot", "benchmark.tasks=2", False),
    ("minilm", "benchmark.tasks=2", True),
    ("minilm", "deterministic=true", False),  # which weights that repeat to the bit need
])  # fmt: skip
def test_runs_share_a_pretraining_with_embeddings_of_the_same_size(tmp_path, language, other, shared) -> None:
    folders = set()
    for own in ("benchmark.tasks=1", other):
        words = (f"language={language}", own, "pretrain.suite=libero_goal", "pretrain.tasks=1")
        config = Configuration(plain_data(composed(*TINY, *words, f"runs_dir={tmp_path}")))
        _, before = experiment._build_contexts(config, config.settings(), RunDirectory(tmp_path), Ranks())
        folders.add(before.directory.path)
    assert (len(folders) == 1) == shared


def test_weights_that_were_pretrained_under_other_conditions_are_named(tmp_path, monkeypatch, capsys) -> None:
    pretraining, context = (run_context(tmp_path / name, "sequential") for name in ("before", "run"))
    monkeypatch.setattr(experiment, "TaskSequence", lambda *_: SimpleNamespace(run=lambda evaluate: None))
    monkeypatch.setattr(experiment, "open_datasets", lambda *_: None)
    plain = dict.fromkeys(experiment.PRETRAIN_KEYS) | {"pretrain": {"suite": "libero_90"}}
    pretraining.directory.log.append(run_start("abc", conditions={"source": "older", "threads": "2"}))
    pretraining.directory.log.append(RunEndRecord(seconds=1.0, finished=utc_now()))
    for source, said in (("older", ""), ("newer", "other conditions than those of this run: source\n")):
        context.directory.log.append(run_start("abc", conditions={"source": source, "threads": "2"}))
        experiment._pretrain(pretraining, context, plain)
        err = capsys.readouterr().err
        assert err.endswith(said) if said else not err


@pytest.fixture
def told_by_names(monkeypatch) -> None:
    """Files of demonstrations need not exist, and are other ones where they have other names."""
    facts, origin = {"models": "builtin", "labels": "intended"}, partial(SimpleNamespace, generator="")
    monkeypatch.setattr(run_demonstrations, "stated_facts", lambda *_: facts)
    monkeypatch.setattr(
        run_demonstrations, "demo_origin", lambda path, count: origin(count=count, digest=path.name)
    )


def test_a_pretraining_is_not_shared_by_runs_with_other_demonstrations(tmp_path, told_by_names) -> None:
    context = run_context(tmp_path, "sequential")
    first, other = ([Path(name)] * len(context.tasks) for name in "ab")
    for _ in range(2):
        run_demonstrations._record_demonstrations(context, first, True)
    with pytest.raises(DataError, match="cannot be shared by a run with other demonstrations than before of"):
        run_demonstrations._record_demonstrations(context, other, True)
    assert len(context.directory.log.read().of(DemonstrationsRecord)) == 1


def test_a_finished_run_is_not_that_of_another_folder_with_other_demonstrations(
    tmp_path, monkeypatch, told_by_names
) -> None:
    context, found = run_context(tmp_path, "sequential"), iter("ab")
    monkeypatch.setattr(
        run_demonstrations, "find_demos", lambda tasks, *_, **__: [Path(next(found))] * len(tasks)
    )
    monkeypatch.setattr(experiment, "_build_contexts", lambda *_: (context, None))
    monkeypatch.setattr(experiment, "_held", lambda *_: nullcontext())
    monkeypatch.setattr(experiment, "_is_finished", lambda context: True)
    monkeypatch.setattr(experiment, "_write_results", lambda *_: None)
    (tmp_path / "config.yaml").write_text("data: {folder: null}")
    run_demonstrations._record_demonstrations(context, [Path("a")] * len(context.tasks), False)

    def again(folder: str) -> None:
        config = composed(*TINY, f"data.folder={folder}", f"runs_dir={tmp_path}")
        experiment.run(config, {"policy": "bc", "benchmark": "libero_goal", "algo": "sequential"})

    again("null")
    again("copied")
    with pytest.raises(DataError, match=f"{context.directory.path} has learned cannot be shared by a run"):
        again("human_demos")
