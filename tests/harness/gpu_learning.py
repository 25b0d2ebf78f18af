"""What learning asks of a GPU, real or pretended. Prints lines of JSON.

    python -m tests.harness.gpu_learning DEVICE learn POLICY[:ALGORITHM,...] ...  # `Learned`, of each or all
    python -m tests.harness.gpu_learning DEVICE step OVERRIDE[,...] ...           # `Asked`, of each step
    python -m tests.harness.gpu_learning DEVICE late                              # memories that differ from the CPU's
    python -m tests.harness.gpu_learning pretended faults                         # what planted faults lead to

DEVICE is `cpu`, `cuda` or `pretended`, POLICY one of `POLICIES`. Another command may follow after `--`.
"""

import sys

if __name__ == "__main__" and sys.argv[1] == "pretended":
    from tests.harness import pretended_gpu  # before torch

import json
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lifelong.algorithms import Sequential
from lifelong.data import SequenceVLDataset, fake_batch
from lifelong.data.compressed import compress
from lifelong.evaluation.actors import Obs, PolicyActor
from lifelong.policies import Policy
from lifelong.results.records import LossRecord
from lifelong.seeding import generator, seeded
from lifelong.sequence.recovery import Recovery
from lifelong.settings import build
from lifelong.training import costs, fit
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch, PolicySpec
from tests.harness import sequences
from tests.harness.configs import CONFIGS, chosen, composed
from tests.harness.policies import small_rnn, small_transformer, small_vilt

GPU = torch.device("cuda")
ALGORITHMS = sorted(file.stem for file in CONFIGS.glob("algo/*.yaml"))
# policy -> a function that builds it, and the augmentation
POLICIES: dict[str, tuple[Callable[..., Policy], str]] = {
    "bc_mlp_small": (lambda spec: build(chosen("policy", "bc_mlp_small"), spec=spec), "shift_jitter"),
    "bc_transformer": (partial(small_transformer, head="gmm", stochastic=True), "libero"),
    "bc_rnn": (partial(small_rnn, head="gmm", stochastic=True), "libero"),
    "bc_transformer_flow": (partial(small_transformer, head="flow"), "shift_jitter"),
    "bc_vilt": (partial(small_vilt, head="deterministic"), "shift"),
}
SHORT = {  # what algorithms compute between tasks
    "dmpel": ["algo.recall_steps=3"],
    "clare": ["algo.discriminator_steps=3", "algo.windows=8"],
    "iscil": ["algo.bases=3"],
}
TASKS = 2
_FIT = FitSettings(epochs=2, steps_per_epoch=2, batch_size=2, lr=1e-3, precision="fp32")


@dataclass
class Learned:
    """What learning with an algorithm came to.

    Attributes:
        algorithm: Its name.
        policy: The policy's.
        losses: Loss of each epoch of the last task.
        launches: Number of kernels of a step of the last task; None where they cannot be counted.
        waits: Where the host waits for the GPU in such a step, in two epochs: before a kill and after it, or the last.
        waits_of_an_action: The same in the last action, of two simulations.
        waits_in_optimizers: The same in all steps of optimisers.
        unsafe: Places of asynchronous copies to the host, whose values may be read before they are there.
        uploads_in_loss: Places in the policy's loss where the GPU reads from the host, which a CUDA graph cannot.
    """

    algorithm: str
    policy: str
    losses: list[float] = field(default_factory=list)
    launches: int | None = None
    waits: list[list[str]] = field(default_factory=list)
    waits_of_an_action: list[str] = field(default_factory=list)
    waits_in_optimizers: list[str] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    uploads_in_loss: list[str] = field(default_factory=list)


@dataclass
class Asked:
    """Kernels of one training step, where the host waits in it, and kernels with which 32 windows are augmented."""

    launches: int
    waits: list[str]
    launches_of_augmentation: int


class Watch:
    """What a GPU is asked to do: by the pretended one, or by PyTorch's warnings of synchronising operations."""

    def __init__(self, device: torch.device, warned: list[warnings.WarningMessage]):
        pretended = sys.modules.get("tests.harness.pretended_gpu")
        self._warned, self._seen = warned, pretended and pretended.SEEN
        self.unsafe: list[str] = self._seen.unsafe if self._seen else []
        self.uploads: list[str] = self._seen.uploads if self._seen else []
        if device.type == "cuda" and not pretended:
            torch.cuda.set_sync_debug_mode("warn")

    @property
    def launches(self) -> int:
        return self._seen.launches if self._seen else 0

    @property
    def waits(self) -> list[str]:
        if self._seen:
            return self._seen.waits
        return [f"{w.filename}:{w.lineno}" for w in self._warned if "synchronizing" in str(w.message)]


@contextmanager
def watched(device: torch.device) -> Iterator[Watch]:
    """Watch a device within the context."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        yield Watch(device, warned)


def learn(algorithm: str, policy: str, device: torch.device) -> Learned:
    """Learn two tasks with an algorithm and act; the first policy is killed in the last task, and resumes."""
    found, kept = Learned(algorithm, policy), slice(-2, None)
    with tempfile.TemporaryDirectory() as folder, watched(device) as watch, ExitStack() as stack:
        _count(found, watch, stack)
        if policy == next(iter(POLICIES)):
            stack.enter_context(patch.object(Recovery, "is_due", lambda _: True))
            with patch.object(Recovery, "save_progress", _save_and_die), suppress(sequences.Killed):
                _sequence(Path(folder), algorithm, policy, device).run()
                raise AssertionError("it was not killed")
            del found.waits[:-1]
            kept = slice(2)
        last = _sequence(Path(folder), algorithm, policy, device)
        last.run()
        losses = [r for r in last.log.read().of(LossRecord) if r.task == TASKS - 1]
    found.losses, found.waits, found.unsafe = [r.loss for r in losses], found.waits[kept], watch.unsafe
    return found


def _save_and_die(
    self: Recovery, task: int, phase: int, fit: Any = None, save: Callable = Recovery.save_progress
) -> None:
    if task == TASKS - 1:
        save(self, task, phase, fit)
    if task == TASKS - 1 and fit is not None and fit["epoch"] == 1:
        raise sequences.Killed


def _sequence(folder: Path, algorithm: str, policy: str, device: torch.device) -> sequences.TaskSequence:
    """Return the tasks, of which the windows of the first are on the device and those of the others are not."""
    make, augmentation = POLICIES[policy]
    with seeded(1):
        built = make(spec=sequences.SPEC).to(device)
    context = sequences.run_context(folder, "sequential", TASKS)
    context = replace(
        context,
        policy=built,
        algorithm=build(chosen("algo", algorithm, *SHORT.get(algorithm, []))),
        augment=build(chosen("augmentation", augmentation)),
        device=device,
        fit=_FIT,
        eval=replace(context.eval, curve="none", select="last", episodes=2, horizon=3),
    )
    data = {task: sequences.dataset(task) for task in range(TASKS)}
    data = {t: windows.with_batches_on(device) if t else windows.to(device) for t, windows in data.items()}
    return sequences.TaskSequence(context, data)


def _count(found: Learned, watch: Watch, stack: ExitStack) -> None:
    """Count launches and waits from the end of an epoch's first step to that of its second, those within optimisers and
    losses, and of actions.
    """
    step, act, loss, ends = Step.__call__, PolicyActor.act, Policy.loss, []

    def counted_step(self: Step, *args: Any) -> Any:
        losses = step(self, *args)
        ends.append((watch.launches, len(watch.waits)))
        return losses

    def counted_epoch(*args: Any) -> Any:
        ends.clear()
        losses = take_steps(*args)
        found.launches = ends[1][0] - ends[0][0] or None
        found.waits.append(watch.waits[ends[0][1] : ends[1][1]])
        return losses

    def counted_loss(self: Policy, batch: Batch) -> torch.Tensor:
        before = len(watch.uploads)
        value = loss(self, batch)
        found.uploads_in_loss.extend(watch.uploads[before:])
        return value

    def counted_act(self: PolicyActor, obs: Obs) -> Any:
        before = len(watch.waits)
        action = act(self, obs)
        found.waits_of_an_action = watch.waits[before:]
        return action

    take_steps, before = fit._take_steps, []
    stack.enter_context(patch.object(Step, "__call__", counted_step))
    stack.enter_context(patch.object(Policy, "loss", counted_loss))
    stack.enter_context(patch.object(PolicyActor, "act", counted_act))
    stack.enter_context(patch.object(fit, "_take_steps", counted_epoch))
    pre = register_optimizer_step_pre_hook(lambda *_: before.append(len(watch.waits)))
    post = register_optimizer_step_post_hook(
        lambda *_: found.waits_in_optimizers.extend(watch.waits[before.pop() :])
    )
    stack.callback(pre.remove), stack.callback(post.remove)


def published_step(words: Sequence[str], device: torch.device) -> Asked:
    """Make two steps on two windows as a configuration says, of smaller pictures, and count what the second asks."""
    config = composed(*words)
    spec = PolicySpec(image_size=(64, 64), seq_len=config.data.seq_len, language_dim=16)
    settings, augment = build(config.train), build(config.augmentation)
    with seeded(0):
        policy = build(config.policy, spec=spec).to(device).train()
    optimizer = torch.optim.AdamW(policy.parameters())
    step = Step(policy, Sequential(), optimizer, settings, augment)
    batch = fake_batch(spec, 2, generator(0)).to(device)
    pictures = torch.zeros(32, 2, 2, 8, 8, 3, dtype=torch.uint8, device=device)
    with watched(device) as watch:
        for _ in range(2):
            before, waits = watch.launches, len(watch.waits)
            step(batch, generator(0), 1e-4)
        asked = watch.launches - before, watch.waits[waits:]
        before = watch.launches
        augment.images(pictures, generator(0))
        return Asked(*asked, watch.launches - before)


def differing_memories(device: torch.device, repeats: int = 1) -> int:
    """Compress windows on a device so often, and count how many times their memory differs from the CPU's."""
    spec, order, wrong = PolicySpec(image_size=(32, 32), seq_len=4), torch.arange(24), 0
    batch = fake_batch(spec, 24, generator(0))
    frames = {"images": batch.observation.images[:, 0], "actions": batch.actions[:, 0]}
    proprio = {name: reading[:, 0] for name, reading in batch.observation.proprio.items()}
    last = torch.full((24,), 23)
    facts = {"language": torch.zeros(384), "task_id": 0, "seq_len": 4}
    plain = SequenceVLDataset(**frames, proprio=proprio, last=last, **facts)
    kept, there = compress(plain, order, 10**8, 60), plain.to(device)
    busy = torch.rand(8192, 8192, device=device) if repeats > 1 else None
    for _ in range(repeats):
        if busy is not None:
            busy @ busy  # so that copies wait for the stream
        found = compress(there, order, 10**8, 60)
        wrong += not (torch.equal(found.codes, kept.codes) and torch.equal(found.actions, kept.actions))
    return wrong


def planted_faults() -> dict[str, str]:
    """Return what faults lead to on the pretended GPU: the error, or the number of what is wrong."""
    there, here = torch.ones(2, device="cuda"), torch.ones(2)
    faults: dict[str, Callable[[], Any]] = {
        "mixed": lambda: there + here,
        "numpy": lambda: there.numpy(),
        "generator": lambda: torch.rand(2, device="cuda", generator=torch.Generator()),
        "late": lambda: _with_late_copies(lambda: differing_memories(GPU)),
        "counters": lambda: len(_waits_of_counters_on_the_gpu()),
    }
    led_to = {}
    for name, fault in faults.items():
        try:
            led_to[name] = str(fault())
        except (RuntimeError, TypeError) as error:
            led_to[name] = f"{type(error).__name__}: {error}"
    return led_to


def _with_late_copies(work: Callable[[], int]) -> int:
    with patch("lifelong.types.to_device", lambda x, device: x.to(device, non_blocking=True)):
        return work()


def _waits_of_counters_on_the_gpu() -> list[str]:
    weight = torch.nn.Parameter(torch.ones(2, device=GPU))
    weight.grad, optimizer = torch.ones_like(weight), torch.optim.AdamW([weight])
    optimizer.step()
    optimizer.state[weight]["step"] = optimizer.state[weight]["step"].to(GPU)
    with watched(GPU) as watch:
        before = len(watch.waits)
        optimizer.step()
        return watch.waits[before:]


def main(device: str, *words: str) -> None:
    if device == "pretended":
        pretended_gpu.pretend()
    chosen = torch.device("cuda" if device == "pretended" else device)
    for is_end, command in groupby(words, "--".__eq__):
        if is_end:
            print("--")
        else:
            answer(chosen, *command, repeats=20 if device == "cuda" else 1)


def answer(device: torch.device, command: str, *words: str, repeats: int) -> None:
    if command == "learn":
        for word in words:
            policy, _, algorithms = word.partition(":")
            first, *others = algorithms.split(",") if algorithms else ALGORITHMS
            print(json.dumps(asdict(learn(first, policy, device))), flush=True)
            with patch.object(costs, "count_flops", lambda: sequences.Uncounted(sequences.Uncounted())):
                for algorithm in others:
                    print(json.dumps(asdict(learn(algorithm, policy, device))), flush=True)
    elif command == "step":
        for word in words:
            print(json.dumps(asdict(published_step(word.split(","), device))))
    else:
        print(json.dumps(planted_faults() if command == "faults" else differing_memories(device, repeats)))


if __name__ == "__main__":
    main(*sys.argv[1:])
