"""Runs saved with the flat configuration keys of earlier versions: they act, are reported and resume.

Each folder of `data/saved_runs` holds what such a run left after its first task, its records of both tasks, and in
`expected.npz` what that version computed: actions after the first task, and every fifth number of the weights after
the second.
"""

import json
import os
import shutil
import subprocess
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
from lifelong.report.page import write_report
from lifelong.report.runs import group_runs, load_run
from lifelong.results.run_directory import result_relevant
from lifelong.results.saved_config import upgrade_config
from lifelong.settings import build
from lifelong.types import Observation
from tests.harness.configs import composed

ROOT = Path(__file__).parents[2]
RUNS = Path(__file__).parent / "data" / "saved_runs"
EVERY = 5  # of the weights' numbers one is stored

SHORT = (
    *(
        "preset=smoke",
        "benchmark=libero_object",
        "benchmark.tasks=2",
        "data.demos=2",
        "data.image_size=32",
        "device=cpu",
        "threads=1",
        "progress=false",
    ),
    *("train.epochs=2", "train.steps_per_epoch=4", "train.batch_size=8"),
    *("eval.episodes=2", "eval.curve_episodes=1", "eval.every=1", "eval.horizon=20", "eval.record_every=0"),
    "eval.select=last",
    *("data.robot=robosuite-1.4.1", "data.drawing=fast"),  # of earlier versions, which had no names for them
)
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
    "policy.head.hidden=32",
)
# The commands of today that configure the saved runs.
COMMANDS = {
    "er": ("algo=er", "compat=libero", "algo.memory.budget=50", "algo.memory.batch_size=null", *RESNET_T),
    "ewc": ("algo=ewc", "algo.strength=null", "algo.estimator.windows=16", *RESNET_T),
    "packnet": (
        *("algo=packnet", "policy=bc_rnn_small", "policy/head=gmm_small"),
        *("policy.image_embed=8", "policy.text_embed=8", *ENCODER, "policy.temporal.hidden=16"),
        *("policy.head.hidden=16", "policy.head.modes=2"),
    ),
    "sequential": (
        *("algo=sequential", "data.image_size=64", "data.seq_len=6"),
        *("policy=bc_vilt_small", "policy/head=flow_small", "policy.head.hidden=16"),
        *("policy.patch_embed=16", "policy.embed_dim=16", "policy.encoder.width=8", *TRANSFORMER),
        *("policy.spatial.layers=1", "policy.spatial.heads=2", "policy.spatial.head_dim=8"),
        "policy.spatial.mlp_dim=32",
    ),
}
every_run = pytest.mark.parametrize("name", COMMANDS)


def todays_config(name: str) -> dict:
    return OmegaConf.to_container(composed(*SHORT, *COMMANDS[name]), resolve=True)


def generator_of(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def saved_config(name: str) -> dict:
    return yaml.safe_load((RUNS / name / "config.yaml").read_text())


@pytest.mark.unit
@every_run
def test_an_upgraded_configuration_is_that_of_todays_command(name):
    assert result_relevant(upgrade_config(saved_config(name))) == result_relevant(todays_config(name))


@pytest.mark.unit
@every_run
def test_a_configuration_of_today_is_not_changed(name):
    now = todays_config(name)
    assert upgrade_config(now) == now
    saved = saved_config(name)
    assert upgrade_config(upgrade_config(saved)) == upgrade_config(saved)
    assert saved == saved_config(name)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("saved", "upgraded"),
    [
        (
            {
                "_target_": "lifelong.algorithms.er.ER",
                "budget": 7,
                "ratio": 2.0,
                "per_task": 5,
                "compat": None,
            },
            {
                "_target_": "lifelong.algorithms.er.ER",
                "ratio": 2.0,
                "memory": {"_target_": "lifelong.data.memory.ReplayMemory", "budget": 7},
            },
        ),
        (
            {"_target_": "lifelong.algorithms.agem.AGEM", "budget": 7, "per_task": 5, "compat": "libero"},
            {
                "_target_": "lifelong.algorithms.agem.AGEM",
                "memory": {
                    "_target_": "lifelong.data.memory.FirstWindows",
                    "budget": 5,
                    "batch_size": None,
                },
                "augment_reference": True,
            },
        ),
        (
            {"_target_": "lifelong.algorithms.ewc.EWC", "strength": 3.0, "fisher": "batch", "compat": None},
            {
                "_target_": "lifelong.algorithms.ewc.EWC",
                "strength": 3.0,
                "estimator": {
                    "_target_": "lifelong.algorithms.importance.BatchFisher",
                    "windows": 512,
                    "batch_size": 32,
                    "augment": False,
                },
            },
        ),
        (
            {"_target_": "lifelong.algorithms.ewc.EWC", "fisher": "per_sample", "compat": "libero"},
            {
                "_target_": "lifelong.algorithms.ewc.EWC",
                "estimator": {
                    "_target_": "lifelong.algorithms.importance.SampleFisher",
                    "windows": 0,
                    "augment": True,
                },
            },
        ),
        (
            {"_target_": "lifelong.algorithms.packnet.PackNet", "compat": "libero"},
            {"_target_": "lifelong.algorithms.packnet.PackNet", "masks_only": True},
        ),
        (
            {"_target_": "lifelong.algorithms.si.SI", "strength": 0.1},
            {"_target_": "lifelong.algorithms.si.SI", "strength": 0.1},
        ),
        ({"_target_": "builtins.dict", "compat": "mine"}, {"_target_": "builtins.dict", "compat": "mine"}),
    ],
)
def test_an_algorithm_is_upgraded_and_can_be_built(saved, upgraded):
    found = upgrade_config({"algo": saved, "compat": saved.get("compat")})
    assert found == {"algo": upgraded}
    build(OmegaConf.create(upgraded))


@pytest.mark.unit
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


@pytest.mark.unit
def test_saved_runs_are_reported_together(tmp_path):
    page = write_report([RUNS / name for name in COMMANDS], tmp_path / "report.html")
    text = page.read_text()
    assert all(name in text for name in COMMANDS)


@pytest.mark.unit
def test_seeds_of_earlier_versions_are_grouped_with_those_of_today(tmp_path):
    """And runs whose components differ are not."""
    runs = [RUNS / "er"]
    for name, overrides in {"same": (), "other": ("compat=none",)}.items():
        shutil.copytree(RUNS / "er", tmp_path / name)
        words = [
            w for w in COMMANDS["er"] if not overrides or "batch_size" not in w
        ]  # a key of compat=libero
        config = composed(*SHORT, *words, "policy.stochastic=true", "eval.selection=reporting", *overrides)
        plain = OmegaConf.to_container(config, resolve=True) | {"seed": 2}
        (tmp_path / name / "config.yaml").write_text(yaml.safe_dump(plain))
        results = tmp_path / name / "results.jsonl"
        results.write_text(results.read_text().replace('"seed": 1', '"seed": 2'))
        runs.append(tmp_path / name)
    groups = group_runs([load_run(run) for run in runs])
    assert [(group.label, len(group.runs)) for group in groups] == [
        ("er (memory FirstWindows)", 2),
        ("er (memory ReplayMemory)", 1),
    ]


@pytest.mark.slow
@pytest.mark.sim
@every_run
def test_a_saved_run_resumes_with_the_command_of_today(name, tmp_path, demonstrations):
    policy = next(word for word in COMMANDS[name] if word.startswith("policy=")).removeprefix("policy=")
    run = tmp_path / "libero_object" / name / f"{policy}_seed1"
    shutil.copytree(RUNS / name, run)
    records = (run / "results.jsonl").read_text().splitlines(keepends=True)
    ends = [number for number, line in enumerate(records) if json.loads(line)["kind"] == "task_end"]
    (run / "results.jsonl").write_text("".join(records[: ends[0] + 1]))
    command = [sys.executable, str(ROOT / "train.py"), *SHORT, *COMMANDS[name], f"runs_dir={tmp_path}"]
    env = os.environ | {"LIBERO_CACHE": str(demonstrations), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Task 1/2" not in done.stdout
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
