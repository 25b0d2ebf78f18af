"""Rollouts of an algorithm's policy, and the command lines of the original, which become those of `libero`."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from libero.libero.benchmark import BENCHMARK_MAPPING, get_benchmark
from libero.libero.envs import OffScreenRenderEnv
from libero.lifelong import algos, evaluate, main, metric
from libero_env.init_states.pickles import write_states
from libero_env.storage import parse_yaml
from lifelong.composition import compose_run
from lifelong.errors import ConfigError
from lifelong.evaluation.rollout import Rollouts
from tests.harness.facade_learning import LANGUAGE, SIZE, TwoTasks, tiny, windows, write_demos

pytestmark = pytest.mark.sim
SMALL = ("train.use_augmentation=false", "+policy.native.encoder.width=8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Demonstrations of two tasks of a suite, of noise."""
    root, suite = tmp_path_factory.mktemp("datasets"), get_benchmark("libero_object")()
    (root / "libero_object").mkdir()
    for i in range(2):
        write_demos(root / suite.get_task_demonstration(i), seed=i)
    return root


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(BENCHMARK_MAPPING, "two_tasks", TwoTasks)


def test_every_key_of_the_original_is_one_of_a_run():
    """The native configuration has each value that the original's words ask for."""
    given = {
        "benchmark_name": ("LIBERO_GOAL", "benchmark.suite", "libero_goal"),
        "seed": ("7", "seed", 7),
        "device": ("cpu", "device", "cpu"),
        "policy": ("bc_rnn_policy", "policy._target_", "lifelong.policies.bc_rnn.BCRNN"),
        "lifelong": ("er", "algo._target_", "lifelong.algorithms.er.ER"),
        "lifelong.n_memories": ("9", "algo.memory.budget", 9),
        "folder": ("/d", "data.folder", "/d"),
        "task_embedding_format": ("one-hot", "language.numbered", True),
        "pretrain_model_path": ("/r", "init_from", "/r"),
        "use_wandb": ("true", "tracker.mode", "online"),
        "wandb_project": ("p", "tracker.project", "p"),
        "data.seq_len": ("5", "data.seq_len", 5),
        "data.img_h": ("64", "data.image_size", 64),
        "data.img_w": ("64", "data.image_size", 64),
        "data.task_order_index": ("3", "benchmark.order", 3),
        "data.task_group_size": ("2", "benchmark.group_size", 2),
        "train.n_epochs": ("4", "train.epochs", 4),
        "train.batch_size": ("8", "train.batch_size", 8),
        "train.grad_clip": ("1.5", "train.grad_clip", 1.5),
        "train.optimizer.kwargs.lr": ("0.1", "train.lr", 0.1),
        "train.optimizer.kwargs.betas": ("[0.8,0.9]", "train.betas", [0.8, 0.9]),
        "train.optimizer.kwargs.weight_decay": ("0.2", "train.weight_decay", 0.2),
        "train.scheduler.kwargs.eta_min": ("0.01", "train.lr_min", 0.01),
        "eval.n_eval": ("6", "eval.curve_episodes", 6),
        "eval.eval_every": ("2", "eval.every", 2),
        "eval.max_steps": ("99", "eval.horizon", 99),
    }
    ewc = {
        "lifelong": ("ewc", "algo._target_", "lifelong.algorithms.ewc.EWC"),
        "lifelong.e_lambda": ("7", "algo.strength", 7),
        "lifelong.gamma": ("0.5", "algo.gamma", 0.5),
    }
    packnet = {
        "lifelong": ("packnet", "algo.masks_only", True),
        "lifelong.prune_perc": ("0.6", "algo.prune_perc", 0.6),
    }
    table = parse_yaml(main.FILE.read_text())["keys"]
    assert {*given, *ewc, *packnet} >= {*table}
    for words in (given, ewc, packnet):
        config, _ = compose_run(main.translated([f"{key}={value}" for key, (value, *_) in words.items()]))
        for key, (_, place, expected) in words.items():
            node = config
            for part in place.split("."):
                node = node[part]
            assert node == expected, key
    chosen = (config.runs_dir, config.language.model, config.eval.select)
    assert chosen == ("experiments", "minilm", "first_best")


def test_lists_options_and_robots_of_the_original(tmp_path, monkeypatch, capsys):
    words = main.translated(["-m", "lifelong=base,er", "seed=1,2", "train.num_workers=4"])
    assert words[0] == "-m" and {"algo=sequential,er", "seed=1,2"} <= set(words)
    assert "train.num_workers=4 has no effect" in capsys.readouterr().out
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    (tmp_path / "config.yaml").write_text(f"robot: robosuite-1.4.1\ndatasets: {tmp_path}\n")
    assert {"data.robot=robosuite-1.4.1", f"data.folder={tmp_path}"} <= set(main.translated([]))


@pytest.mark.parametrize(("word", "message"), [
    ("policy.embed_size=3", "Did you mean 'policy.embed_dim'"),
    ("train.n_epoch=3", "Did you mean 'train.epochs'"),
    ("data.img_h=32", "data.img_h=32 and data.img_w=64 are both data.image_size"),
    ("lifelong=hat", "packnet"),
    ("benchmark_name=LIBERO_1", "libero_spatial"),
])  # fmt: skip
def test_errors_are_printed_on_one_line(word, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["main", "device=cpu", "data.img_w=64", word])
    assert main.main() == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1


def test_an_evaluation_names_a_run_of_main(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr("libero_cli.main.main", lambda words: asked.append(words) or 0)
    named = ["--benchmark", "LIBERO_GOAL", "--task_id", "2", "--policy", "bc_rnn_policy"]
    named += ["--seed", "7", "--algo"]
    assert evaluate.main([*named, "base", "--load_task", "5", "--device_id", "1", "--save_videos"]) == 0
    assert evaluate.main([*named, "multitask"]) == 0
    run = "experiments/libero_goal/{}/bc_rnn_seed7 --suite libero_goal/2"
    words = [" ".join(["libero", *one]) for one in asked]
    assert words == [
        f"libero eval {run.format('sequential')} --after 5 --device cuda:1 --videos 50",
        f"libero eval {run.format('multitask')}",
    ]
    monkeypatch.undo()
    assert evaluate.main([*named, "er"]) == 2
    assert "experiments/libero_goal/er/bc_rnn_seed7" in capsys.readouterr().err


@pytest.fixture(scope="module")
def acting(folder, tmp_path_factory):
    """An untrained algorithm on the first two tasks."""
    cfg = tiny(*SMALL, "eval.n_eval=3", "eval.num_procs=2", "benchmark_name=two_tasks")
    cfg.experiment_dir = str(tmp_path_factory.mktemp("experiment"))
    windows(folder / get_benchmark("libero_object")().get_task_demonstration(0), cfg)
    suite = TwoTasks()
    suite.set_task_embs(torch.randn(2, LANGUAGE))
    torch.manual_seed(0)
    return algos.Sequential(2, cfg), cfg, suite


def record_starts(monkeypatch, run):
    """Return a list of the starts of the next calls."""
    begun = []
    replaced = lambda a, e, rows, **k: begun.append(list(rows)) or run(a, e, rows, **k)  # noqa: E731
    monkeypatch.setattr(metric, "run_episodes", replaced)
    return begun


def test_success_is_measured_from_the_first_states(acting, monkeypatch):
    algo, cfg, suite = acting
    begun = record_starts(monkeypatch, metric.run_episodes)
    rate = metric.evaluate_one_task_success(cfg, algo, suite.get_task(1), suite.get_task_emb(1), 1)
    assert (rate, begun) == (0.0, [[0, 1], [2]])
    monkeypatch.setitem(cfg.eval, "use_mp", False)
    assert metric.evaluate_multitask_training_success(cfg, algo, suite, [0]).tolist() == [0.0]
    assert begun[2:] == [[0], [1], [2]], "one by one"
    for keep in ({"sim_states": []}, {}):
        monkeypatch.setitem(cfg.eval, "save_sim_states", not keep)
        with pytest.raises(ConfigError, match="save_sim_states is true: states are not kept"):
            metric.evaluate_one_task_success(cfg, algo, suite.get_task(1), None, 1, **keep)


def test_all_states_of_a_users_folder_count(acting, monkeypatch, tmp_path):
    algo, cfg, suite = acting
    begun = record_starts(monkeypatch, lambda *_, **__: Rollouts((), 0.0))
    task, states = suite.get_task(0), suite.get_task_init_states(0)
    monkeypatch.setitem(cfg, "init_states_folder", str(tmp_path))
    monkeypatch.setitem(cfg.eval, "n_eval", 60)
    monkeypatch.setitem(cfg.eval, "num_procs", 60)
    file = tmp_path / task.problem_folder / task.init_states_file
    write_states(file, np.concatenate([states, states[:8]]))
    metric.evaluate_one_task_success(cfg, algo, task, suite.get_task_emb(0), 0)
    assert begun == [[*range(58), 0, 1]]


def test_rollouts_read_what_the_configuration_names_or_refuse(acting, monkeypatch):
    algo, cfg, suite = acting
    monkeypatch.setitem(cfg.data.obs_key_mapping, "joint_states", "robot0_joint_vel")
    with pytest.raises(ConfigError, match="joint_states is robot0_joint_vel: rollouts read robot0_joint_pos"):
        metric.evaluate_success(cfg, algo, suite, [0])
    monkeypatch.setitem(cfg.data.obs_key_mapping, "joint_states", "robot0_joint_pos")
    monkeypatch.setitem(cfg.data.obs_key_mapping, "unused", "robot0_joint_vel")
    assert metric.evaluate_success(cfg, algo, suite, [0]).shape == (1,)


def test_success_is_counted(acting, monkeypatch):
    """The goal is made to hold in two of three episodes."""
    algo, cfg, suite = acting
    monkeypatch.setitem(cfg.eval, "use_mp", True)
    monkeypatch.setitem(cfg.eval, "num_procs", 3)
    step = metric.BatchEnv.step

    def succeeded(self, actions):
        obs, rewards, terminated, truncated, info = step(self, actions)
        info["success"] = np.array([True, False, True])
        return obs, rewards, info["success"], truncated, info

    monkeypatch.setattr(metric.BatchEnv, "step", succeeded)
    rates = metric.evaluate_success(cfg, algo, suite, [0], {})
    assert rates == pytest.approx([2 / 3])


def test_observations_of_the_environment_are_those_of_rollouts(acting, monkeypatch):
    """`raw_obs_to_tensor_obs` of the facade's environment equals the input of the policy in a rollout."""
    algo, cfg, suite = acting
    seen, act = [], algo.policy.get_action
    algo.policy.get_action = lambda data: seen.append(data) or act(data)
    monkeypatch.setitem(cfg.eval, "n_eval", 1)
    states = suite.get_task_init_states(0)
    try:
        metric.evaluate_one_task_success(cfg, algo, suite.get_task(0), suite.get_task_emb(0), 0)
    finally:
        del algo.policy.get_action
    size = {"camera_heights": SIZE, "camera_widths": SIZE}
    env = OffScreenRenderEnv(bddl_file_name=suite.get_task_bddl_file_path(0), **size)
    env.reset()
    env.set_init_state(states[0])
    for _ in range(metric.SETTLE_STEPS):
        obs, *_ = env.step(np.zeros(7))
    data = metric.raw_obs_to_tensor_obs([obs], suite.get_task_emb(0), cfg)
    env.close()
    assert list(data["obs"]) == list(seen[0]["obs"]) and torch.equal(data["task_emb"], seen[0]["task_emb"])
    for key, value in data["obs"].items():
        assert value.shape == seen[0]["obs"][key].shape and value.dtype == torch.float32
        if "hand" not in key:  # the headlight is at the hand's camera there, at the first camera here
            assert (value - seen[0]["obs"][key]).abs().mean() < 0.01, key  # there one substep earlier
    assert algo.policy.get_action(data).shape == (1, 7)


def test_user_defined_states_and_tasks(acting, tmp_path, monkeypatch):
    """A folder with other initial states, and one with another task file of the same name."""
    algo, cfg, suite = acting
    task, states = suite.get_task(0), suite.get_task_init_states(0)
    moved = states[:2].copy()
    moved[:, 1] += 0.3  # the first joint
    write_states(tmp_path / task.problem_folder / task.init_states_file, moved)
    seen, act = [], algo.policy.get_action
    replaced = lambda data: seen.append(data["obs"]["joint_states"]) or act(data)  # noqa: E731
    monkeypatch.setattr(algo.policy, "get_action", replaced)
    for folder in (None, str(tmp_path)):
        monkeypatch.setitem(cfg, "init_states_folder", folder)
        metric.evaluate_one_task_success(cfg, algo, task, suite.get_task_emb(0), 0)
    plain, own = seen[0], seen[len(seen) // 2]
    assert (own - plain)[0, 0].item() == pytest.approx(0.3, abs=0.05)
    native = metric.native_task(task, None)
    assert native.suite == "libero_object" and native.name == task.name
    (tmp_path / task.problem_folder / task.bddl_file).write_text(native.bddl_text + "\n; mine\n")
    assert metric.native_task(task, str(tmp_path)).suite == "file"
