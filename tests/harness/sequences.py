"""A sequence of three tasks with a tiny policy and a fake environment; simulated kills of runs."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict

import numpy as np
import torch

from libero_env.tasks import get_suite
from lifelong import algorithms as algos
from lifelong import checkpoints
from lifelong.algorithms import Algorithm
from lifelong.context import RunContext
from lifelong.data import SequenceVLDataset
from lifelong.data.memory import PhaseMemory, ReplayMemory
from lifelong.data.settings import DataSettings
from lifelong.evaluation.environments import EnvPool
from lifelong.evaluation.settings import EvalSettings
from lifelong.results.records import CostRecord, RunRecord
from lifelong.results.run_directory import RunDirectory
from lifelong.seeding import generator, seeded
from lifelong.sequence import TaskSequence
from lifelong.streams import StreamSettings
from lifelong.tracking import Tracker
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec
from tests.harness.kills import assert_same as assert_same
from tests.harness.policies import small_transformer

SPEC = PolicySpec(views=("agentview_rgb",), image_size=(16, 16), proprio={"x": 2}, language_dim=4, seq_len=3)
TASKS = 3
ALGORITHMS: dict[str, Callable[[], Algorithm]] = {
    "sequential": algos.Sequential,
    "er": lambda: algos.ER(memory=ReplayMemory(12)),
    "ewc": algos.EWC,
    "packnet": algos.PackNet,
}
EVERY = ALGORITHMS | {
    "agem": lambda: algos.AGEM(memory=ReplayMemory(25)),
    "averaging": algos.Averaging,
    "clare": lambda: algos.CLARE(rank=2, hidden=2, discriminator_steps=3, threshold=1.5, windows=5),
    "compressed_er": lambda: algos.CompressedER(budget=9_000),
    "derpp": lambda: algos.DERpp(budget=25, alpha=0.5),
    "dmpel": lambda: algos.DMPEL(rank=2, alpha=4.0, pool=2, recall_steps=20),
    "iscil": lambda: algos.IsCiL(rank=2, alpha=4.0, bases=3, states=10),
    "lora": lambda: algos.LoRA(rank=2, alpha=4.0),
    "lora_one": lambda: algos.LoRA(rank=2, alpha=4.0, adapters="shared"),
    "lwf": algos.LwF,
    "m2distill": lambda: algos.M2Distill(budget=12),
    "mas": algos.MAS,
    "mir": lambda: algos.MIR(memory=ReplayMemory(25), candidates=2),
    "mlr": lambda: algos.MLR(budget=30, adjustment=0.3),
    "multitask": algos.Multitask,
    "omla": lambda: algos.OMLA(rank=2, alpha=4.0),
    "phase_er": lambda: algos.ER(memory=PhaseMemory(25)),
    "self_distillation": lambda: algos.LwF(instruction="own"),
    "si": algos.SI,
    "single_task": algos.SingleTask,
    "slca": algos.SLCA,
}


class FakeEnv:
    """Succeeds depending on the size of the actions; does not move afterwards."""

    def __init__(self, task: int, num_envs: int):
        self.num_envs, self.task, self.closed = num_envs, task, False

    def _obs(self):
        draws = np.random.default_rng(self.steps)
        pictures = draws.integers(0, 255, (self.num_envs, 16, 16, 3), np.uint8)
        return {"agentview_rgb": pictures, "x": self.position}

    def reset(self, *, seed=None, options=None):
        self.states = np.asarray(options["init_state"])
        self.steps, self.position = 0, np.stack([self.states / 50, self.states * 0 + self.task], 1)
        self.running = np.ones(self.num_envs, bool)
        return self._obs(), {}

    def step(self, actions):
        self.steps += 1
        reached = self.running & (np.abs(actions[:, 0]) * 5 > self.states % 4) & (self.steps > 2)
        self.position = self.position + 0.1 * actions[:, :2] * self.running[:, None]
        self.running &= ~reached
        success = ~self.running
        return self._obs(), reached * 1.0, reached, np.zeros(self.num_envs, bool), {"success": success}

    def close(self):
        self.closed = True


def dataset(task: int, demos: int = 2) -> SequenceVLDataset:
    draws, frames = generator(task), 20
    return SequenceVLDataset(
        torch.randint(0, 256, (frames, 1, 16, 16, 3), generator=draws, dtype=torch.uint8),
        {"x": torch.randn(frames, 2, generator=draws)},
        torch.rand(frames, 7, generator=draws) * 2 - 1,
        torch.arange(1, demos + 1).mul(frames // demos).sub(1).repeat_interleave(frames // demos),
        torch.randn(4, generator=draws),
        task,
        SPEC.seq_len,
    )


def run_context(path, algo: str | Callable[[], Algorithm], tasks: int = TASKS) -> RunContext:
    with seeded(7):
        policy = small_transformer(SPEC)
    return RunContext(
        tasks=get_suite("libero_object").tasks[:tasks],
        languages=torch.stack([dataset(task).language for task in range(tasks)]),
        demos=(2,) * tasks,
        data=DataSettings(demos=2, image_size=16, seq_len=SPEC.seq_len, views=SPEC.views, proprio=()),
        policy=policy,
        algorithm=(ALGORITHMS[algo] if isinstance(algo, str) else algo)(),
        envs=EnvPool(lambda key: FakeEnv(*key), 2),
        fit=FitSettings(epochs=2, batch_size=8, lr=1e-2, precision="fp32"),
        eval=EvalSettings(episodes=3, curve_episodes=2, every=1, horizon=6, settle_steps=1, precision="fp32"),
        augment=None,
        stream=StreamSettings(),
        group_sizes=(1,) * tasks,
        directory=RunDirectory(path),
        tracker=Tracker(),
        seed=1,
        device=torch.device("cpu"),
        progress=False,
    )


def sequence(context: RunContext, first: int = 0) -> TaskSequence:
    """The tasks of a context with datasets of small random windows, numbered from `first` on."""
    return TaskSequence(context, {task: dataset(task + first) for task in range(len(context.tasks))})


def outcome(path, log, last: int = TASKS - 1):
    """Return all records without their times, and the weights and algorithm's state after the last task."""
    kept = {}
    for record in log.read().records:
        if isinstance(record, RunRecord):  # says when the run was started
            continue
        values = {k: v for k, v in asdict(record).items() if k != "seconds"}
        if isinstance(record, CostRecord):  # what is counted, not what is measured
            counted = [k for k in record.costs if not k.endswith("seconds") and "peak" not in k]
            values["costs"] = {k: record.costs[k] for k in counted}
        key = tuple(values.get(k) for k in ("kind", "phase", "learned", "task", "epoch"))
        key += tuple(values.get("costs", ()))
        assert kept.setdefault(key, values) == values, "a record was made twice, and differs"
    return kept, checkpoints.load(RunDirectory(path).checkpoints.task_path(last))


class Uncounted(nullcontext):
    """In place of the counter of operations: more at each reading, as if each part had matrix products."""

    readings = 0

    def get_total_flops(self) -> int:
        self.readings += 1
        return self.readings


class Killed(BaseException):
    """Stands for a killed process."""


class Killer:
    """Allows N writes, then ends the process in the middle of one."""

    def __init__(self, monkeypatch, writes: int):
        self.left = writes
        monkeypatch.setattr(checkpoints, "save", self.guard(checkpoints.save))

    def guard(self, write):
        def guarded(*args, **kwargs):
            if self.left == 0:
                raise Killed
            self.left -= 1
            return write(*args, **kwargs)

        return guarded
