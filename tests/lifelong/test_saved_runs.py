"""Saved runs act, are reported and resume as they did when they were saved.

Each folder of `data/saved_runs` holds what a run left after its first task, its records of both tasks, and in
`expected.npz` what was computed: actions after the first task, and every fifth number of the weights after
the second.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from lifelong import checkpoints
from lifelong.data.fake import fake_observation
from lifelong.evaluation.restore import restore
from lifelong.launch import main
from lifelong.report.page import write_report
from lifelong.results.provenance import result_relevant
from lifelong.types import Observation
from tests.harness.configs import composed

RUNS = Path(__file__).parent / "data" / "saved_runs"
EVERY = 5  # of the weights' numbers one is stored

SHORT = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "data.demos=2", "data.image_size=32",
     "device=cpu", "threads=1", "progress=false"),
    *("train.epochs=2", "train.steps_per_epoch=4", "train.batch_size=8", "train.lr=0.003", "train.warmup_steps=10"),
    "data.seq_len=2",
    *("eval.episodes=2", "eval.curve_episodes=1", "eval.every=1", "eval.horizon=20", "eval.record_every=0"),
    "eval.select=last",
    *("data.robot=robosuite-1.4.1", "data.drawing=fast"),
)  # fmt: skip
ENCODER = (
    *("policy.encoder.width=8", "policy.encoder.stage_blocks=[1]", "policy.encoder.stem_stride=8"),
    "policy.encoder.keypoints=8",
)
TRANSFORMER = (
    *("policy.temporal.layers=1", "policy.temporal.heads=2", "policy.temporal.head_dim=8"),
    "policy.temporal.mlp_dim=32",
)
RESNET_T = (
    *("policy=bc_transformer_small", "policy.embed_dim=8", *ENCODER, *TRANSFORMER),
    *("policy/head=deterministic_small", "policy.head.hidden=32", "policy.readout=instruction"),
    *("policy.encoder.stem_film=false", "policy.temporal.final_norm=false"),
)
# Their commands.
COMMANDS = {
    "er": ("algo=er", "compat=libero", "algo.memory.budget=50", "algo.memory.batch_size=null", *RESNET_T),
    "ewc": ("algo=ewc", "algo.strength=null", "algo.estimator.windows=16", *RESNET_T),
    "packnet": (*("algo=packnet", "policy=bc_rnn_small", "policy/head=gmm_small"),
     *("policy.image_embed=8", "policy.text_embed=8", *ENCODER, "policy.temporal.hidden=16"),
     *("policy.head.hidden=16", "policy.head.modes=2", "policy.head.min_std=0.02", "policy.head.acts=heaviest")),
    "sequential": (*("algo=sequential", "data.image_size=64", "data.seq_len=6"),
     *("policy=bc_vilt_small", "policy/head=flow_small", "policy.head.hidden=16"),
     *("policy.patch_embed=16", "policy.embed_dim=16", "policy.encoder.width=8", *TRANSFORMER),
     *("policy.spatial.layers=1", "policy.spatial.heads=2", "policy.spatial.head_dim=8"),
     "policy.spatial.mlp_dim=32"),
}  # fmt: skip
every_run = pytest.mark.parametrize("name", COMMANDS)


def generator_of(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@every_run
def test_a_saved_configuration_is_that_of_its_command(name):
    saved = yaml.safe_load((RUNS / name / "config.yaml").read_text())
    now = OmegaConf.to_container(composed(*SHORT, *COMMANDS[name]), resolve=True)
    was, now = ({k: v for k, v in result_relevant(one).items() if v is not None} for one in (saved, now))
    assert was == now, "an older run may lack what is null"


@every_run
def test_a_restored_policy_acts_as_it_did(name):
    run = restore(RUNS / name, device="cpu")
    window = fake_observation(run.policy.spec, 2, generator_of(0), steps=3)
    generators, actions = [generator_of(1), generator_of(2)], []
    with run.acting(run.tasks[0]) as policy:
        policy.reset(2)
        for t in range(3):
            proprio = {key: value[:, t : t + 1] for key, value in window.proprio.items()}
            step = Observation(window.images[:, t : t + 1], proprio, window.language)
            actions.append(policy.act(step, generators).numpy())
    expected = np.load(RUNS / name / "expected.npz")["actions"]
    np.testing.assert_allclose(np.stack(actions, 1), expected, rtol=0, atol=1e-6)


def test_saved_runs_are_reported_together(tmp_path):
    page = write_report([RUNS / name for name in COMMANDS], tmp_path / "report.html")
    text = page.read_text()
    assert all(name in text for name in COMMANDS)


@pytest.mark.slow
@pytest.mark.sim
@pytest.mark.parametrize("name", ["er", "packnet"])
def test_a_saved_run_resumes_to_the_same_weights(name, tmp_path, demonstrations, monkeypatch, capsys):
    policy = next(word for word in COMMANDS[name] if word.startswith("policy=")).removeprefix("policy=")
    run = tmp_path / "libero_object" / name / f"{policy}_seed1"
    shutil.copytree(RUNS / name, run)
    records = (run / "results.jsonl").read_text().splitlines(keepends=True)
    ends = [number for number, line in enumerate(records) if json.loads(line)["kind"] == "task_end"]
    (run / "results.jsonl").write_text("".join(records[: ends[0] + 1]))
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.setenv("LIBERO_CACHE", str(demonstrations))
    assert main([*SHORT, *COMMANDS[name], f"runs_dir={tmp_path}"]) == 0
    assert "Task 1/2" not in capsys.readouterr().out
    weights = checkpoints.load(run / "checkpoints" / "task_1.safetensors")["policy"]
    expected = np.load(RUNS / name / "expected.npz")
    assert {f"weights/{key}" for key in weights} | {"actions"} == set(expected.files)
    for key, value in weights.items():
        stored = expected[f"weights/{key}"]
        np.testing.assert_allclose(value.flatten()[::EVERY].numpy(), stored, rtol=0, atol=1e-6, err_msg=key)


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory) -> Path:
    """The cache that the resumed runs share: their demonstrations are recorded again."""
    return tmp_path_factory.mktemp("cache")
