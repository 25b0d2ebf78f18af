"""Whole runs of the original's configuration: from demonstrations to checkpoints, results and their evaluation."""

import os
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from libero.libero.benchmark import BENCHMARK_MAPPING, get_benchmark
from libero.libero.envs import OffScreenRenderEnv
from libero.lifelong import algos, evaluate, main, metric, run_evaluation, utils
from libero.lifelong import run as run_module
from libero.lifelong.run import run
from libero_env.init_states.pickles import write_states
from libero_env.tasks import get_task
from lifelong import checkpoints
from lifelong.errors import ConfigError
from lifelong.evaluation.rollout import Episode, Rollouts
from tests.harness.facade_learning import (
    LANGUAGE,
    SIZE,
    TINY,
    TINY_TRANSFORMER,
    TwoTasks,
    tiny,
    windows,
    write_demos,
)

pytestmark = pytest.mark.sim

ROOT = Path(__file__).parents[2]
SMALL = ("train.use_augmentation=false", "+policy.native.encoder.width=8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Demonstrations of the ten tasks of a suite, of noise."""
    root, suite = tmp_path_factory.mktemp("datasets"), get_benchmark("libero_object")()
    (root / "libero_object").mkdir()
    for i in range(suite.n_tasks):
        write_demos(root / suite.get_task_demonstration(i), seed=i)
    return root


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(BENCHMARK_MAPPING, "two_tasks", TwoTasks)


def config(folder: Path, *overrides: str):
    return tiny(*SMALL, f"folder={folder}", "benchmark_name=two_tasks", *overrides)


def test_demonstrations_may_be_links_as_in_the_cache_of_hugging_face(tmp_path):
    suite = get_benchmark("libero_object")()
    file = tmp_path / suite.get_task_demonstration(0)
    file.parent.mkdir()
    (tmp_path / "blob").write_bytes(b"")
    file.symlink_to("../blob")
    assert run_module.demonstrations(tiny(f"folder={tmp_path}"), suite, 0) == file


def test_a_run_and_the_evaluation_of_its_checkpoint(folder, capsys):
    path = run(
        config(folder, "lifelong=packnet", "lifelong.post_prune_epochs=1", "eval.save_sim_states=true")
    )
    assert path == Path("experiments/two_tasks/PackNet/BCTransformerPolicy_seed10000/run_001")
    result = torch.load(path / "result.pt")
    assert {k: tuple(result[k].shape) for k in ("L_conf_mat", "S_conf_mat", "L_fwd", "S_fwd")} == {
        "L_conf_mat": (2, 2), "S_conf_mat": (2, 2), "L_fwd": (2,), "S_fwd": (2,)
    }  # fmt: skip
    assert (result["L_conf_mat"] != 0).tolist() == [[True, False], [True, True]]
    assert (result["S_conf_mat"] == 0).all(), "no policy succeeds in four steps"
    for key in ("k1_p0", "k0_e1"):
        ((*states,),) = result[key]
        assert len(states) == 1 + 4 and states[0].shape == states[-1].shape
        times = [state[0] for state in states]
        assert np.allclose(times, 0.05 * (np.arange(5) + metric.SETTLE_STEPS)), "from where the policy begins"

    named = "--benchmark two_tasks --task_id 0 --algo packnet --policy bc_transformer_policy --seed 10000"
    arguments = [*named.split(), "--load_task", "1"]
    assert evaluate.main([*arguments, "--save-videos", "--n_eval", "2"]) == 0
    assert "success 0/2 = 0%" in capsys.readouterr().out
    stats = torch.load(path / "task1_model_on0.stats")
    assert stats["successes"] == [False, False] and stats["interval"][1] > 0.3
    assert stats["loss"] == pytest.approx(result["L_conf_mat"][1, 0].item()), (
        "the same weights, the same masks"
    )
    assert len(list((path / "task1_model_on0_videos").iterdir())) == 2
    assert evaluate.main([*arguments, "--ep", "3"]) == 2
    assert "--ep: a checkpoint of packnet is named by the last task before it" in capsys.readouterr().err
    assert evaluate.main([*arguments[:-1], "7"]) == 2
    assert "task0_model.pth, task1_model.pth" in capsys.readouterr().err


def test_evaluation_of_a_group_of_tasks_acts_with_the_weights_of_the_group(folder, monkeypatch):
    class FourTasks(TwoTasks):
        def __init__(self, task_order_index: int = 0):
            super().__init__(task_order_index)
            self.tasks, self.n_tasks = get_benchmark("libero_object")().tasks[:4], 4

    monkeypatch.setitem(BENCHMARK_MAPPING, "two_tasks", FourTasks)
    grouped = (
        "data.task_group_size=2",
        "lifelong=packnet",
        "lifelong.post_prune_epochs=0",
        "eval.eval=false",
    )
    path, acted = run(config(folder, *grouped)), []

    def rollouts(cfg, algo, *args, **kwargs):
        acted.append(algo.policy.state_dict())
        return [Episode(0, False, 1)]

    monkeypatch.setattr(run_evaluation, "rollouts", rollouts)
    named = "--benchmark two_tasks --algo packnet --policy bc_transformer_policy --seed 10000 --load_task 1 --task_id"
    for task in ("2", "0"):
        assert evaluate.main([*named.split(), task]) == 0
    stored = utils.torch_load_model(path / "task1_model.pth")[0]
    of_group, of_first = ([n for n, p in stored.items() if not torch.equal(p, found[n])] for found in acted)
    assert not of_group and of_first


def test_an_interrupted_run_resumes_to_the_same_weights(folder):
    whole = run(config(folder, "lifelong=er", "eval.eval=false"))
    first = run(config(folder, "lifelong=er", "eval.eval=false"))
    for name in ("task1_state.safetensors", "task1_model.pth"):
        (first / name).unlink()
    with pytest.raises(
        ConfigError, match=r"train.resume: lifelong.n_memories is 7, but .* began with \d+; give that"
    ):
        run(config(folder, "lifelong=er", "eval.eval=false", "train.resume=true", "lifelong.n_memories=7"))
    second = run(config(folder, "lifelong=er", "eval.eval=false", "train.resume=true"))
    assert second == first
    states = [checkpoints.load(path / "task1_state.safetensors") for path in (whole, second)]
    assert all(torch.equal(states[0]["policy"][n], states[1]["policy"][n]) for n in states[0]["policy"])
    assert torch.equal(*[torch.load(path / "result.pt")["L_fwd"] for path in (whole, second)])
    begun = run(
        config(folder, f"pretrain_model_path={whole}/task1_model.pth", "train.n_epochs=0", "eval.eval=false")
    )
    assert begun.parts[0] == "experiments_finetune"
    kept = utils.torch_load_model(begun / "task1_model.pth")[0]
    assert all(torch.equal(kept[n], p) for n, p in states[0]["policy"].items())


class NotingAlgorithm(algos.Sequential):
    """Adds entries of its own to the results."""

    def learn_one_task(self, dataset, task_id, benchmark, result_summary):
        result_summary["notes"] = {"task": task_id, "norms": np.arange(3.0), "name": "noting"}
        return super().learn_one_task(dataset, task_id, benchmark, result_summary)


def test_results_of_a_user_defined_algorithm_are_written_too(folder):
    cfg = config(folder, "lifelong.algo=NotingAlgorithm", "eval.eval=false", "train.n_epochs=0")
    notes = torch.load(run(cfg) / "result.pt")["notes"]
    assert (notes["task"], notes["norms"].tolist(), notes["name"]) == (1, [0.0, 1.0, 2.0], "noting")


@pytest.mark.parametrize("robot", ["libero", "robosuite-1.4.1"])
def test_missing_demonstrations_are_generated(folder, robot, tmp_path, monkeypatch, capsys):
    """The expert is asked for the demonstrations that the configuration needs; here it returns noise."""
    asked = []
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    (tmp_path / "config.yaml").write_text(f"robot: {robot}\n")

    def record(tasks, count, *, camera_size, robot):
        asked.append((*tasks, count, camera_size, robot))
        return [folder / get_benchmark("libero_object")().get_task_demonstration(0)]

    monkeypatch.setattr(run_module, "ensure_demos", record)
    cfg = config(folder / "elsewhere", "eval.eval=false", "train.n_epochs=0")
    path = run(cfg)
    assert asked == [(get_task(f"libero_object/{i}"), 50, (SIZE, SIZE), robot) for i in range(2)]
    assert "scripted expert" in capsys.readouterr().out
    _, stored, _ = utils.torch_load_model(path / "task0_model.pth")
    assert len(stored.demonstrations) == 2
    (tmp_path / "config.yaml").unlink()  # a run is evaluated with the arm that it has learned with
    with closing(
        metric._EvalEnv(stored, get_benchmark("libero_object")().tasks[0], 1, None, None, None)
    ) as env:
        assert env.config.robot == env.scene.robot == robot


@pytest.mark.slow
def test_from_the_command_line(folder, tmp_path):
    """The script itself, with groups of tasks; modules of its folder do not shadow others of their names."""
    command = [
        sys.executable, str(ROOT / "libero/lifelong/main.py"), *TINY, *TINY_TRANSFORMER, *SMALL, f"folder={folder}",
        "benchmark_name=LIBERO_OBJECT", "lifelong=multitask", "eval.eval=false", "data.task_group_size=5",
        "train.debug=true", "seed=7"
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=dict(os.environ))
    assert done.returncode == 0, done.stderr
    assert "train.debug=True has no effect" in done.stdout
    path = tmp_path / "experiments/LIBERO_OBJECT/Multitask/BCTransformerPolicy_seed7/run_001"
    assert {p.name for p in path.glob("*.pth")} == {
        "multitask_model.pth",
        "multitask_model_ep0.pth",
        "multitask_model_ep1.pth",
    }
    assert torch.load(path / "result.pt")["S_conf_mat"].shape == (2, 2)


def test_errors_are_printed_on_one_line(folder, monkeypatch, capsys):
    for override, message in (
        ("lifelong=hat", "lifelong 'hat'.*packnet"),
        ("benchmark_name=LIBERO_1", "libero_spatial"),
        ("data.task_group_size=3", "task_group_size=3"),
        ("init_states_folder=/no/such", "init_states_folder=/no/such: no such folder"),
        ("bddl_folder=/no/such", "bddl_folder=/no/such: no such folder"),
    ):
        monkeypatch.setattr(
            sys, "argv", ["main", f"folder={folder}", "device=cpu", "benchmark_name=LIBERO_OBJECT", override]
        )
        assert main.main() == 2
        error = capsys.readouterr().err
        assert re.search(message, error) and error.count("\n") == 1


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


def test_success_is_measured_from_the_first_states(acting, monkeypatch):
    algo, cfg, suite = acting
    begun, real = [], metric.run_episodes
    monkeypatch.setattr(
        metric, "run_episodes", lambda a, e, rows, **k: begun.append(list(rows)) or real(a, e, rows, **k)
    )
    rate = metric.evaluate_one_task_success(cfg, algo, suite.get_task(1), suite.get_task_emb(1), 1)
    assert (rate, begun) == (0.0, [[0, 1], [2]])
    monkeypatch.setitem(cfg.eval, "selection", "apart")
    monkeypatch.setitem(cfg.eval, "use_mp", False)
    assert metric.evaluate_multitask_training_success(cfg, algo, suite, [0]).tolist() == [0.0]
    assert begun[2:] == [[47], [48], [49]], "one by one, in states that no report uses"
    monkeypatch.setitem(cfg.eval, "n_eval", 26)
    with pytest.raises(ConfigError, match=r"eval.n_eval is 26: .* at most half"):
        metric.evaluate_multitask_training_success(cfg, algo, suite, [0])


def test_all_states_of_a_users_folder_count(acting, monkeypatch, tmp_path):
    algo, cfg, suite = acting
    begun = []
    monkeypatch.setattr(
        metric, "run_episodes", lambda a, e, rows, **k: begun.append(list(rows)) or Rollouts((), 0.0)
    )
    task, states = suite.get_task(0), suite.get_task_init_states(0)
    monkeypatch.setitem(cfg, "init_states_folder", str(tmp_path))
    monkeypatch.setitem(cfg.eval, "n_eval", 60)
    monkeypatch.setitem(cfg.eval, "num_procs", 60)
    file = tmp_path / task.problem_folder / task.init_states_file
    write_states(file, np.concatenate([states, states[:8]]))
    metric.evaluate_one_task_success(cfg, algo, task, suite.get_task_emb(0), 0)
    assert begun == [[*range(58), 0, 1]]
    write_states(file, states[:20])
    monkeypatch.setitem(cfg.eval, "selection", "apart")
    monkeypatch.setitem(cfg.eval, "n_eval", 10)
    metric.evaluate_multitask_training_success(cfg, algo, suite, [0])
    assert begun[1] == [*range(10, 20)], "none of those that are reported"
    monkeypatch.setitem(cfg.eval, "n_eval", 11)
    with pytest.raises(ConfigError, match=r"eval.n_eval is 11: .* at most half of the 20"):
        metric.evaluate_multitask_training_success(cfg, algo, suite, [0])


def test_rollouts_read_what_the_configuration_names_or_refuse(acting, monkeypatch):
    algo, cfg, suite = acting
    monkeypatch.setitem(cfg.data.obs_key_mapping, "joint_states", "robot0_joint_vel")
    with pytest.raises(
        ConfigError, match=r"obs_key_mapping.joint_states is robot0_joint_vel: rollouts read robot0_joint_pos"
    ):
        metric.evaluate_success(cfg, algo, suite, [0])
    monkeypatch.setitem(cfg.data.obs_key_mapping, "joint_states", "robot0_joint_pos")
    monkeypatch.setitem(cfg.data.obs_key_mapping, "unused", "robot0_joint_vel")
    assert metric.evaluate_success(cfg, algo, suite, [0]).shape == (1,)


def test_states_of_the_tasks_of_a_group_are_apart(acting, monkeypatch):
    _, cfg, suite = acting
    monkeypatch.setitem(cfg.eval, "save_sim_states", True)
    monkeypatch.setattr(
        metric, "evaluate_one_task_success", lambda c, a, t, e, i, states, **_: states[0].append(i) or 0.0
    )
    summary = {"k0_e0": [[] for _ in range(2 * cfg.eval.n_eval)]}
    metric.evaluate_success(cfg, torch.nn.Identity(), suite, [0, 1], summary, key="k0_e0")
    assert [lists for lists in summary["k0_e0"] if lists] == [[0], [1]]
    assert summary["k0_e0"][cfg.eval.n_eval] == [1]


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


def test_observations_of_the_environment_are_those_of_rollouts(acting):
    """`raw_obs_to_tensor_obs` of the facade's environment equals the input of the policy in a rollout."""
    algo, cfg, suite = acting
    seen, act = [], algo.policy.get_action
    algo.policy.get_action = lambda data: seen.append(data) or act(data)
    states = suite.get_task_init_states(0)
    try:
        metric.rollouts(cfg, algo, suite.get_task(0), suite.get_task_emb(0), 0, [4])
    finally:
        del algo.policy.get_action
    size = {"camera_heights": SIZE, "camera_widths": SIZE}
    env = OffScreenRenderEnv(bddl_file_name=suite.get_task_bddl_file_path(0), drawing="fast", **size)
    env.reset()
    env.set_init_state(states[4])
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


def test_user_defined_states_and_tasks(acting, tmp_path):
    """A folder with other initial states, and one with another task file of the same name."""
    algo, cfg, suite = acting
    task, states = suite.get_task(0), suite.get_task_init_states(0)
    moved = states[:2].copy()
    moved[:, 1] += 0.3  # the first joint
    write_states(tmp_path / task.problem_folder / task.init_states_file, moved)
    found = [[]]
    cfg.init_states_folder = str(tmp_path)
    try:
        metric.rollouts(cfg, algo, task, suite.get_task_emb(0), 0, [1], sim_states=found)
    finally:
        cfg.init_states_folder = None
    assert found[0][0][1] == pytest.approx(moved[1, 1], abs=0.05)
    own = metric.native_task(task, None)
    assert own.suite == "libero_object" and own.name == task.name
    (tmp_path / task.problem_folder / task.bddl_file).write_text(own.bddl_text + "\n; mine\n")
    assert metric.native_task(task, str(tmp_path)).suite == "file"
