"""Loading of a run's policy, and its saliency."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image

from libero_env.tasks import get_task
from lifelong import checkpoints
from lifelong.data import SequenceVLDataset, fake_batch
from lifelong.data.fake import fake_observation
from lifelong.errors import ConfigError, LifelongError
from lifelong.evaluation.restore import restore
from lifelong.evaluation.saliency import SaliencySettings
from lifelong.evaluation.saliency_sheet import draw_saliency
from lifelong.seeding import generator, seeded
from lifelong.settings import build
from lifelong.types import PolicySpec

pytestmark = pytest.mark.unit
CONFIGS = Path(__file__).parents[2] / "configs"
TINY = ("preset=smoke", "device=cpu", "data.image_size=32", "policy.encoder.width=8", "policy.head.hidden=16")


def make_windows(task: int, spec: PolicySpec) -> SequenceVLDataset:
    """Eight random frames of one demonstration."""
    observation, draws = fake_observation(spec, 1, generator(task), steps=8), generator(task)
    proprio = {name: value[0] for name, value in observation.proprio.items()}
    actions = 2 * torch.rand(8, spec.action_dim, generator=draws) - 1
    last = torch.full((8,), 7)
    return SequenceVLDataset(
        observation.images[0], proprio, actions, last, observation.language[0], task, spec.seq_len
    )


def make_run(folder: Path, *overrides: str):
    """Write the files of a run with two learned tasks that loading needs; return the policy after each."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("config", [*TINY, *overrides])
    folder.mkdir(parents=True)
    plain = OmegaConf.to_container(config, resolve=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(plain))
    tasks = build(config.benchmark).sequence()
    spec = build(config.data).spec(build(config.language).embed([t.language for t in tasks]).shape[1])
    with seeded(3):
        policy, algorithm, states = build(config.policy, spec=spec), build(config.algo), []
    batch = fake_batch(spec, 4, generator(0))
    for task in range(2):
        windows = make_windows(task, spec)
        algorithm.begin_task(task, windows, policy)
        algorithm.begin_phase(algorithm.phases()[0], policy)
        with torch.no_grad(), seeded(task):
            for p in algorithm.trained(policy):
                p.add_(0.1 * torch.randn_like(p))
        algorithm.after_step(policy)
        algorithm.end_phase(algorithm.phases()[0], policy)
        algorithm.end_task(task, windows, policy, generator(task))
        state = {"task": task, "policy": policy.state_dict(), "algorithm": algorithm.state_dict()}
        checkpoints.save(folder / "checkpoints" / f"task_{task}.safetensors", state)
        states.append(checkpoints.load(folder / "checkpoints" / f"task_{task}.safetensors")["policy"])
    answers = []
    for task in range(2):
        with algorithm.policy_for(task, policy) as acting, torch.no_grad():
            answers.append(acting.eval().predict(batch))
    return tasks, states, batch, answers


def test_weights_after_a_given_task_and_after_the_last_by_default(tmp_path):
    tasks, states, *_ = make_run(tmp_path / "run", "algo=sequential")
    for after, wanted in ((None, 1), (0, 0), (1, 1)):
        found = restore(tmp_path / "run", after=after)
        assert found.learned == wanted and found.tasks == tasks and not found.policy.training
        for name, value in found.policy.state_dict().items():
            assert torch.equal(value, states[wanted][name])
    from_file = restore(tmp_path / "run" / "checkpoints" / "task_0.safetensors")
    assert (from_file.learned, from_file.path) == (0, tmp_path / "run")


@pytest.mark.parametrize("algo", ["er", "packnet", "single_task", "lora"])
def test_a_loaded_policy_acts_as_the_algorithm_does(tmp_path, algo):
    tasks, _, batch, answers = make_run(tmp_path / "run", f"algo={algo}")
    found = restore(tmp_path / "run")
    for task, answer in zip(tasks, answers, strict=True):
        with found.acting(task) as policy, torch.no_grad():
            assert torch.equal(policy.predict(batch), answer)
    assert torch.equal(answers[0], answers[1]) == (algo == "er"), "else each task has weights of its own"
    with found.acting(get_task("libero_goal/1")) as policy, torch.no_grad():
        assert torch.equal(policy.predict(batch), answers[1]), "on other tasks as on the last"


def test_instructions_are_embedded_as_in_the_run(tmp_path):
    tasks, *_ = make_run(tmp_path / "run", "language=onehot")
    found = restore(tmp_path / "run")
    assert found.embed(tasks[1]).tolist() == [0.0, 1.0]
    with pytest.raises(LifelongError, match="not one of its tasks"):
        found.embed(get_task("libero_goal/1"))


def test_paths_that_are_no_runs_are_named(tmp_path):
    with pytest.raises(LifelongError, match="no run directory"):
        restore(tmp_path)
    make_run(tmp_path / "run")
    with pytest.raises(LifelongError, match=r"no checkpoint after task 5; valid: \[0, 1\]"):
        restore(tmp_path / "run", after=5)
    (tmp_path / "run" / "config.yaml").unlink()
    with pytest.raises(LifelongError, match="needs the configuration of its run"):
        restore(tmp_path / "run" / "checkpoints" / "task_0.safetensors")


@pytest.mark.sim
def test_saliency_sheet_of_a_run(tmp_path):
    make_run(tmp_path / "run")
    settings = SaliencySettings(stride=43, sigma=20)
    path = draw_saliency(tmp_path / "run", task=1, moments=3, horizon=4, settings=settings)
    assert path == tmp_path / "run" / "saliency" / "task_01_after_01.png"
    with Image.open(path) as sheet:
        assert sheet.size == (3 * (128 + 4), 4 * (128 + 4))
        assert np.asarray(sheet).std() > 10
    assert "failure, after learning 2 tasks; steps 0, 2, 3" in path.with_suffix(".txt").read_text()
    with pytest.raises(ConfigError, match="tasks 0 to 1"):
        draw_saliency(tmp_path / "run", task=2)
