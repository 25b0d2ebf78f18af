"""Runs as they are on disk, with small policies that have learned nothing: what loading and acting need."""

from pathlib import Path

import torch
import yaml
from omegaconf import OmegaConf

from lifelong import checkpoints
from lifelong.data import SequenceVLDataset, fake_batch
from lifelong.data.fake import fake_observation
from lifelong.results.run_directory import CheckpointFolder
from lifelong.seeding import generator, seeded
from lifelong.settings import build
from lifelong.types import PolicySpec
from tests.harness.configs import composed

TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "device=cpu", "data.image_size=32"),
    *("data.seq_len=2", "policy.encoder.width=8", "policy.head.hidden=16"),
)


def make_windows(task: int, spec: PolicySpec) -> SequenceVLDataset:
    """Eight random frames of one demonstration."""
    observation, draws = fake_observation(spec, 1, generator(task), steps=8), generator(task)
    proprio = {name: value[0] for name, value in observation.proprio.items()}
    actions = 2 * torch.rand(8, spec.action_dim, generator=draws) - 1
    images, language, last = observation.images[0], observation.language[0], torch.full((8,), 7)
    return SequenceVLDataset(images, proprio, actions, last, language, task, spec.seq_len)


def make_run(folder: Path, *overrides: str):
    """Write the files of a run with two learned tasks that loading needs; return the policy after each."""
    config = composed(*TINY, *overrides)
    folder.mkdir(parents=True)
    plain = OmegaConf.to_container(config, resolve=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(plain))
    tasks = build(config.benchmark).sequence()
    spec = build(config.data).spec(build(config.language).embed([t.language for t in tasks]).shape[1])
    with seeded(3):
        policy, algorithm, states = build(config.policy, spec=spec), build(config.algo), []
    batch, saved = fake_batch(spec, 4, generator(0)), CheckpointFolder(folder / "checkpoints")
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
        saved.save_task(task, policy.state_dict(), algorithm.state_dict())
        states.append(checkpoints.load(folder / "checkpoints" / f"task_{task}.safetensors")["policy"])
    answers = []
    for task in range(2):
        with algorithm.policy_for(task, policy) as acting, torch.no_grad():
            answers.append(acting.eval().predict(batch))
    return tasks, states, batch, answers
