"""The task sequence with every algorithm: killed anywhere and resumed, it comes to the same records and weights."""

import copy
import math

import pytest
import torch

from lifelong import algorithms as algos
from lifelong.report.tables import COST_COLUMNS
from lifelong.results.records import EvalRecord, LossRecord, TaskEndRecord
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.fit import fit
from tests.harness.algorithms import (
    SMALL,
    assert_resumed_equals_uninterrupted,
    frame,
    learn_frames,
    make_policy,
    predict,
)
from tests.harness.configs import CONFIGS, composed
from tests.harness.gpu_learning import POLICIES, learn
from tests.harness.sequences import EVERY, TASKS, assert_same, dataset, run_context, sequence

pytestmark = pytest.mark.usefixtures("uncounted")  # test_costs counts
COMPAT = {
    f"{name} of the original": lambda words=words: build(composed(*words, "compat=libero").algo)
    for name, words in (("er", ("algo=er", "algo.memory.budget=5")), ("packnet", ("algo=packnet",)))
} | {
    f"lora, {kind}": lambda kind=kind: algos.LoRA(rank=2, alpha=4.0, adapters=kind)
    for kind in ("shared", "averaged")
}


def test_every_algorithm_is_here():
    assert {file.stem for file in CONFIGS.glob("algo/*.yaml")} == set(EVERY)


@pytest.mark.parametrize(("first", "make"), list(enumerate((EVERY | COMPAT).values())), ids=EVERY | COMPAT)
def test_killed_and_resumed_equals_uninterrupted(tmp_path, first, make, monkeypatch):
    assert_resumed_equals_uninterrupted(tmp_path, make, monkeypatch, first=1 + first % 6)


@pytest.mark.parametrize("name", sorted(set(EVERY) - {"packnet"}))  # which prunes
def test_the_first_task_is_learned_as_by_fine_tuning(name):
    plain, policy = make_policy(), make_policy()
    fit(plain, dataset(0), algos.Sequential(), settings=SMALL, seed=(0, 0))
    learn_frames(EVERY[name](), policy, 0)
    assert_same(dict(policy.state_dict()), dict(plain.state_dict()))


def actions(policy, windows):
    """Return the actions of an episode in which the windows' last frames are seen, (T, 7)."""
    policy.eval().reset(1)
    frames = [windows.batch(torch.tensor([k])).observation for k in range(0, 20, 4)]
    frames = [frame(seen, seen.images.shape[1] - 1) for seen in frames]
    return torch.cat([policy.act(seen, [generator(k)]) for k, seen in enumerate(frames)])


@pytest.mark.parametrize("make", EVERY.values(), ids=EVERY)
def test_acting_leaves_the_policy_as_it_was(make):
    policy, algorithm = make_policy(), make()
    learn_frames(algorithm, policy, 0, 1)
    before, names = copy.deepcopy(dict(policy.state_dict())), set(vars(policy))
    for task in (0, 1):
        predict(algorithm, policy, dataset(task).batch(range(20)), task)
    with algorithm.policy_for(1, policy) as acting:
        own, copied = (actions(one, dataset(1)) for one in (acting, copy.deepcopy(acting)))
    assert torch.equal(own, copied)
    assert_same(dict(policy.state_dict()), before)
    assert set(vars(policy)) == names and not any(m._forward_hooks for m in policy.modules())


# the others: above, and test_gpu
@pytest.mark.parametrize("policy", sorted(POLICIES.keys() - {"bc_transformer", "bc_mlp_small"}))
def test_every_algorithm_learns_with_every_policy(policy):
    for name in EVERY:
        learned = learn(name, policy, torch.device("cpu"))
        assert learned.losses and all(map(math.isfinite, learned.losses)), name


@pytest.mark.parametrize("quiet", ["0", "1"])
def test_the_records_are_complete(quiet, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIBERO_QUIET", quiet)
    sequence(p := run_context(tmp_path, "packnet")).run()
    shown = capsys.readouterr()
    assert (shown.out == "") == (quiet == "1") and not shown.err
    results = p.directory.log.read()
    assert len(results.of(TaskEndRecord)) == TASKS
    evals = results.of(EvalRecord)
    assert len([r for r in evals if r.phase == "matrix"]) == TASKS * (TASKS + 1) // 2
    assert sorted((r.learned, r.epoch) for r in evals if r.phase == "curve") == [
        (task, epoch) for task in range(TASKS) for epoch in (0, 1, 2)
    ]
    assert {r.epoch for r in results.of(LossRecord)} == {1, 2, 3, 4}  # training and retraining
    counted = set(COST_COLUMNS) - {"training_seconds", "evaluation_seconds", "peak_gpu_bytes"}
    assert all(set(results.costs(task)) >= counted for task in range(TASKS))
    assert all(set(r.init_states) == ({0, 1, 2} if r.phase == "matrix" else {48, 49}) for r in evals)
    # twice two epochs of 20 windows by eight; packnet keeps none
    assert [results.costs(task)["updates"] for task in range(TASKS)] == [4 * 3] * TASKS
    assert all(results.costs(task)["kept_share"] == 0 for task in range(TASKS))


@pytest.mark.parametrize(("name", "last"), [("er", 20.0), ("multitask", 0.0), ("mlr", 50.0)])
def test_the_share_of_windows_that_is_kept_is_of_all_tasks_so_far(tmp_path, name, last):
    sequence(context := run_context(tmp_path, EVERY[name])).run()
    results = context.directory.log.read()
    found = [costs["kept_share"] for costs in results.costs_by_task().values()]
    assert found[-1] == pytest.approx(last)  # of 60: 12, none or 30
    updates = sum(costs["updates"] for costs in results.costs_by_task().values())
    assert updates == (16 if name == "multitask" else 18)  # epochs of 60 windows by eight, or of 20 thrice


def test_select_last_keeps_the_last_weights(tmp_path):
    p = run_context(tmp_path, "sequential")
    object.__setattr__(p.eval, "select", "last")
    sequence(p).run()
    assert not p.directory.checkpoints.best_path.exists()
    assert {r.best_epoch for r in p.directory.log.read().of(TaskEndRecord)} == {2}


@pytest.mark.parametrize("name", ["lora", "omla", "dmpel", "iscil", "clare"])
def test_a_pretrained_base_has_adapters_drawn_by_the_runs_seed(tmp_path, name):
    """The first adapter, before it learns: that of the run's seed, whatever was drawn elsewhere."""

    class Begun(Exception):
        pass

    def stop(*_):
        raise Begun

    drawn = []
    for seed in (1, 2, 2):
        context = run_context(tmp_path / str(len(drawn)), EVERY[name], tasks=1)
        context.algorithm.base_left, context.algorithm.begin_phase = 0, stop
        object.__setattr__(context, "seed", seed)
        torch.manual_seed(len(drawn))
        with pytest.raises(Begun):
            sequence(context).run(evaluate=False)
        pairs = context.algorithm.library.values()
        drawn.append(torch.cat([pair["a"].flatten() for of_task in pairs for pair in of_task.values()]))
    assert torch.equal(drawn[1], drawn[2]) and not torch.equal(drawn[0], drawn[1])


@pytest.mark.parametrize("name", ["er", "derpp", "mlr", "m2distill", "agem", "mir", "phase_er"])
def test_a_budget_of_fewer_windows_than_tasks_is_learned_with_and_read_back(name):
    policy, algorithm = make_policy(), EVERY[name]()
    algorithm.memory.budget = 2
    learn_frames(algorithm, policy, 0, 1, 2, 3)
    again = EVERY[name]()
    again.load_state_dict(algorithm.state_dict(), {task: dataset(task) for task in range(4)})
    assert_same(again.state_dict(), algorithm.state_dict())
