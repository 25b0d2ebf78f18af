"""Loading of a run's policy, and its saliency."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from libero_env.tasks import get_task
from libero_eval.policies import RunPolicy
from libero_eval.protocols.files import load_protocol
from libero_eval.requests import Request, SaliencyRequest
from libero_eval.saliency import draw_saliency
from lifelong.errors import ConfigError, LifelongError
from lifelong.evaluation.restore import restore
from tests.harness.runs import make_run


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


def test_a_task_that_occurs_twice_is_acted_on_by_position(tmp_path):
    _, states, batch, answers = make_run(
        tmp_path / "run", "algo=single_task", "benchmark.tasks=[0,0]", "language=onehot"
    )
    found = restore(tmp_path / "run")
    for position, answer in enumerate(answers):
        with found.acting(position) as policy, torch.no_grad():
            assert torch.equal(policy.predict(batch), answer)
        assert found.embed(position).tolist() == np.eye(2)[position].tolist()


@pytest.mark.parametrize("dim", [(), ("language.dim=4",)])
def test_instructions_are_embedded_as_in_the_run(tmp_path, dim):
    tasks, *_ = make_run(tmp_path / "run", "language=onehot", *dim)
    found = restore(tmp_path / "run")
    assert found.embed(tasks[1]).tolist()[:2] == [0.0, 1.0]
    with pytest.raises(LifelongError, match="not one of its tasks"):
        found.embed(get_task("libero_goal/1"))


def test_instructions_in_other_words_are_embedded_as_they_are(tmp_path):
    tasks, *_ = make_run(tmp_path / "run")
    found = restore(tmp_path / "run")
    reworded = replace(tasks[1], language="the same in other words")
    told = found.embed(reworded)
    assert not torch.equal(told, found.embed(tasks[1]))
    assert torch.equal(told, found.language.embed([*found.instructions, reworded.language])[-1])


def test_paths_that_are_no_runs_are_named(tmp_path):
    with pytest.raises(LifelongError, match="not a run directory"):
        restore(tmp_path)
    with pytest.raises(LifelongError, match="missing does not exist; give the directory of a run"):
        restore(tmp_path / "missing")
    make_run(tmp_path / "run")
    with pytest.raises(LifelongError, match=r"no checkpoint after task 5; valid: \[0, 1\]"):
        restore(tmp_path / "run", after=5)
    with pytest.raises(LifelongError, match=r"is one checkpoint, and after=1 names another"):
        restore(tmp_path / "run" / "checkpoints" / "task_0.safetensors", after=1)
    (tmp_path / "run" / "config.yaml").unlink()
    with pytest.raises(LifelongError, match="needs the configuration of its run"):
        restore(tmp_path / "run" / "checkpoints" / "task_0.safetensors")


@pytest.mark.sim
def test_saliency_sheet_of_a_run(tmp_path):
    make_run(tmp_path / "run")
    request = SaliencyRequest(run=tmp_path / "run", task=1, moments=3, horizon=4, stride=43)
    path = draw_saliency(request)
    assert path == tmp_path / "run" / "saliency" / "task_01_after_01_start_00.png"
    with Image.open(path) as sheet:
        assert sheet.size == (3 * (128 + 4), 4 * (128 + 4))
        assert np.asarray(sheet).std() > 10
    said = f"failure within 4 steps, and the run's horizon is {restore(request.run).eval.horizon}, after learning 2"
    assert f"{said} tasks; start 0, steps 0, 2, 3" in path.with_suffix(".txt").read_text()
    with pytest.raises(ConfigError, match="tasks 0 to 1"):
        draw_saliency(replace(request, task=2))


@pytest.mark.parametrize("drawing", ["faithful", "fast"])
def test_a_run_is_evaluated_with_the_drawing_that_it_was_trained_with(tmp_path, drawing):
    make_run(tmp_path / "run")
    file = tmp_path / "run" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    config["data"]["drawing"] = drawing
    file.write_text(yaml.safe_dump(config))
    request = Request(policy=str(tmp_path / "run"), device="cpu", threads=1, assets="builtin")
    policy = RunPolicy(request)
    env = policy.env(policy.run.tasks[0], 1, policy.protocol(load_protocol("libero")))
    try:
        assert env.scene.drawing == drawing
    finally:
        env.close()
