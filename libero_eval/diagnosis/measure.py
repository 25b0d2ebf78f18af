"""Measurements on the checkpoints of a run: updates, Fisher information, drift of features, and swapped parts.

The parts of a policy are what `encode`, `over_time` and `head` compute with. Whatever is said of a task is said of the
policy that acts on it, so that weights of a task's own (PackNet, LoRA, single_task) count as what they are.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from libero_eval.relearning import CHUNK, Measure, measured_on, task_windows, with_demos
from libero_eval.requests import DiagnoseRequest
from lifelong.algorithms.base import Algorithm, acting_with
from lifelong.algorithms.importance import SampleFisher
from lifelong.errors import LifelongError
from lifelong.evaluation.restore import LoadedRun, read_config, restore
from lifelong.nn import GMMHead
from lifelong.policies.base import copy_weights, device_of, in_mode
from lifelong.policies.history import HistoryPolicy, with_features
from lifelong.seeding import generator
from lifelong.stats.representations import (
    effective_rank,
    fisher_overlap,
    linear_cka,
    relative_distance,
    stable_rank,
)
from lifelong.types import Batch

PARTS = ("encoder", "temporal", "head")
FISHER_WINDOWS = 256  # of a task
SAMPLES = 64  # actions drawn at a frame
Weights = Mapping[str, Tensor]


@dataclass(frozen=True)
class Update:
    """What learning a task changed in a part of the policy, over its matrices; convolutions are flattened.

    Attributes:
        relative: Norm of the change over the norm of the weights before it.
        nuclear: Sum of the nuclear norms of the changes.
        effective: Mean effective rank of the changes as a share of the largest possible rank.
        stable: Mean stable rank of the changes.
    """

    task: int
    part: str
    relative: float
    nuclear: float
    effective: float
    stable: float


@dataclass(frozen=True)
class Overlap:
    """Overlap of the Fisher information of two tasks, of all weights and within each part."""

    tasks: tuple[int, int]
    all: float
    parts: dict[str, float]


@dataclass(frozen=True)
class Drift:
    """How far the last frames of a task's held-out windows moved at one place of the policy since it was learned.

    Attributes:
        place: `features` leave the encoder, `latents` enter the head, `actions` leave it.
    """

    task: int
    place: str
    cka: float
    relative: float


@dataclass(frozen=True)
class Moved:
    """How far learning a task moved the policy on held-out frames of that task.

    Attributes:
        kl: Kullback-Leibler divergence of the policy after the task from that before it, [nats] an action.
    """

    task: int
    kl: float


@dataclass(frozen=True)
class Swap:
    """An old task under the last policy, and with one part of it put back; errors or shares of failed rollouts.

    Attributes:
        measure: `error` on held-out windows, or `failures` of rollouts.
        swapped: What remains with each part as it was just after the task.
    """

    task: int
    measure: str
    learned: float
    final: float
    swapped: dict[str, float]

    @property
    def lost(self) -> float:
        """What was lost since the task was just learned; 0 where it is less than a tenth of what remained then."""
        lost = self.final - self.learned
        return lost if lost > max(0.0, 0.1 * self.learned) else 0.0

    def restored(self, part: str) -> float:
        """Return the share of what was lost that a part's return brings back; NaN where nothing was lost."""
        return (self.final - self.swapped[part]) / self.lost if self.lost else float("nan")


@dataclass(frozen=True)
class Diagnosis:
    """Everything measured on a run; tasks are positions from 0.

    Attributes:
        learned: Number of tasks learned.
        notes: What is left out, and why.
    """

    run: str
    algorithm: str
    instructions: tuple[str, ...]
    learned: int
    notes: tuple[str, ...]
    updates: tuple[Update, ...]
    moved: tuple[Moved, ...]
    overlaps: tuple[Overlap, ...]
    drifts: tuple[Drift, ...]
    swaps: tuple[Swap, ...]


def diagnose(request: DiagnoseRequest) -> Diagnosis:
    """Measure on a run's checkpoints what moved while it learned, and what old tasks lost by it.

    Raises:
        LifelongError: There is nothing earlier to compare with, a checkpoint or demonstrations are missing, or the
            algorithm acts by more than the policy's weights.
        PolicyError: The policy has no `encode`, `over_time` and `head`.
    """
    run = with_demos(restore(request.run, device=request.device, allow=request.allow), request.demos)
    config, algorithm = read_config(run.path / "config.yaml", request.allow), type(run.algorithm).__name__
    policy, plain = with_features(run.policy), type(run.algorithm).policy_for is Algorithm.policy_for
    if not plain and not run.algorithm.acts_by_weights:
        raise LifelongError(
            f"{run.path}: {algorithm} acts with experts beside the policy's layers, which are not swapped; "
            "valid: algorithms that act by the policy's weights, such as sequential, er, ewc, packnet and lora"
        )
    stages = {task: stage[-1] for stage in run.stages for task in stage if stage[-1] <= run.learned}
    ends = sorted(set(stages.values()))
    if len(ends) < 2:
        raise LifelongError(
            f"{run.path} has learned its {len(stages)} tasks in one stage; a diagnosis needs two or more stages"
        )
    just = {end: _just_after(run, end, request) for end in ends}
    before = dict(zip(ends[1:], ends, strict=False))
    swaps, drifts, moved, fishers = [], [], [], {}
    for task, end in stages.items():
        training, held_out = task_windows(run, task, request.held_out, config, request.demos)
        assert held_out is not None  # at least one demonstration is held out
        parts = parts_of(policy, held_out.rows(slice(1)).to(run.device))
        with acting_with(policy, just[end]):
            estimator = SampleFisher(windows=FISHER_WINDOWS)
            fishers[task] = estimator.estimate(training, policy, generator(run.seed, task))
        if end in before and isinstance(policy.head, GMMHead):
            draws = generator(run.seed, task)
            moved.append(Moved(task, divergence(policy, just[before[end]], just[end], held_out, draws)))
        if end == ends[-1]:
            continue
        with run.acting(task) as acting:
            now = copy_weights(acting)
        drifts += drift(policy, task, just[end], now, held_out)
        measures = [(held_out, 0, "error")] + [(None, request.episodes, "failures")] * bool(request.episodes)
        for batch, episodes, name in measures:
            with measured_on(run, task, batch, episodes) as measure:
                swaps.append(swap(policy, task, just[end], now, parts, measure, name))
    later = [(a, b) for a in stages for b in stages if stages[a] < stages[b]]
    separate = None if plain or _act_alike(run, ends) else algorithm
    steps = [] if separate else list(zip(ends, ends[1:], strict=False))
    return Diagnosis(
        run=str(run.path),
        algorithm=algorithm,
        instructions=tuple(run.learned_task(task).language for task in stages),
        learned=len(stages),
        notes=tuple(_notes(run, len(stages), separate)),
        updates=tuple(found for a, b in steps for found in updates(b, just[a], just[b], parts)),
        moved=() if separate else tuple(moved),
        overlaps=tuple(overlap(pair, fishers[pair[0]], fishers[pair[1]], parts) for pair in later),
        drifts=tuple(drifts),
        swaps=tuple(swaps),
    )


def _just_after(run: LoadedRun, end: int, request: DiagnoseRequest) -> Weights:
    """Return the weights that acted on a stage's tasks just after it."""
    then = restore(run.path, after=end, device=request.device, allow=request.allow)
    with then.acting(end) as policy:
        return copy_weights(policy)


def _act_alike(run: LoadedRun, ends: Sequence[int]) -> bool:
    """Return whether the same weights act on the tasks of all stages."""
    acting = []
    for end in (ends[0], ends[-1]):
        with run.acting(end) as policy:
            acting.append(copy_weights(policy))
    return all(torch.equal(value, acting[1][name]) for name, value in acting[0].items())


def _notes(run: LoadedRun, learned: int, separate: str | None) -> list[str]:
    notes = []
    if learned < len(run.tasks):
        notes.append(f"The run is not finished: {learned} of {len(run.tasks)} tasks are learned.")
    if separate:
        notes.append(f"Updates are left out: {separate} gives each task weights of its own.")
    return notes


def parts_of(policy: HistoryPolicy, batch: Batch) -> dict[str, list[str]]:
    """Return the names of the weights and buffers of each part that has some.

    The head is `head`; what runs in `over_time` is temporal; the rest is the encoder.

    Args:
        batch: Windows to run the policy on, on its device.
    """
    called: set[str] = set()

    def note(name: str) -> Callable[..., None]:
        return lambda *_: called.add(name)

    children: list[tuple[str, nn.Module]] = list(policy.named_children())
    with torch.no_grad(), in_mode(policy, training=False):
        features = policy.encode(batch.observation)
        hooks = [module.register_forward_pre_hook(note(name)) for name, module in children]
        try:
            policy.over_time(features)
        finally:
            for hook in hooks:
                hook.remove()
    parts: dict[str, list[str]] = {part: [] for part in PARTS}
    for name in policy.state_dict():
        child = name.partition(".")[0]
        parts["head" if child == "head" else "temporal" if child in called else "encoder"].append(name)
    return {part: names for part, names in parts.items() if names}


def updates(task: int, before: Weights, after: Weights, parts: Mapping[str, list[str]]) -> list[Update]:
    """Return what changed between two sets of weights in each part; parts without a changed matrix are left out."""
    found = []
    for part, names in parts.items():
        pairs = [(before[n].double(), after[n].double()) for n in names if before[n].dim() > 1]
        changed = [(a, (b - a).flatten(1)) for a, b in pairs if not torch.equal(a, b)]
        if not changed:
            continue
        values = [torch.linalg.svdvals(change).cpu().numpy() for _, change in changed]
        sizes = [sum(float(x.square().sum()) for x in column) for column in zip(*changed, strict=True)]
        found.append(
            Update(
                task=task,
                part=part,
                relative=float(np.sqrt(sizes[1] / sizes[0])) if sizes[0] else float("inf"),
                nuclear=float(sum(v.sum() for v in values)),
                effective=float(np.mean([effective_rank(v) / len(v) for v in values])),
                stable=float(np.mean([stable_rank(v) for v in values])),
            )
        )
    return found


def overlap(
    tasks: tuple[int, int], first: Weights, second: Weights, parts: Mapping[str, list[str]]
) -> Overlap:
    """Return the overlap of two tasks' Fisher information, of all weights and within each part."""

    def among(names: list[str]) -> float:
        known = [n for n in names if n in first]
        if not known:  # a part that is frozen whole
            return float("nan")
        flat = [torch.cat([fisher[n].flatten() for n in known]).double() for fisher in (first, second)]
        return fisher_overlap(flat[0].cpu().numpy(), flat[1].cpu().numpy())

    return Overlap(tasks, among(list(first)), {part: among(names) for part, names in parts.items()})


def drift(policy: HistoryPolicy, task: int, then: Weights, now: Weights, batch: Batch) -> list[Drift]:
    """Return how far the same frames moved, from some weights to others, at each place of the policy."""
    seen = []
    for weights in (then, now):
        with acting_with(policy, weights):
            seen.append(_places(policy, batch))
    return [
        Drift(task, place, linear_cka(seen[0][place], seen[1][place]), relative_distance(a, seen[1][place]))
        for place, a in seen[0].items()
    ]


@torch.no_grad()
def _places(policy: HistoryPolicy, batch: Batch) -> dict[str, Any]:
    """Return features, latents and mean actions of the last frame of each window, each (N, ...) float64."""
    rows: dict[str, list[Tensor]] = {"features": [], "latents": [], "actions": []}
    with in_mode(policy, training=False):
        for chosen in torch.arange(len(batch)).split(CHUNK):
            features = policy.encode(batch.rows(chosen).to(device_of(policy)).observation)
            latents = policy.over_time(features)
            actions = policy.head.mean(policy.head(latents))
            for name, values in zip(rows, (features, latents, actions), strict=True):
                rows[name].append(values[:, -1].flatten(1).double().cpu())
    return {name: torch.cat(values).numpy() for name, values in rows.items()}


@torch.no_grad()
def divergence(
    policy: HistoryPolicy, before: Weights, after: Weights, batch: Batch, draws: torch.Generator
) -> float:
    """Return KL(before || after) of a mixture, [nats], mean over the actions of windows, from `SAMPLES` draws of each.

    Learning a task in fewer nats forgets less (Shenfeld et al. 2025, "RL's Razor", arXiv:2509.04259).
    """
    assert isinstance(policy.head, GMMHead)
    found = []
    for weights in (before, after):
        with acting_with(policy, weights), in_mode(policy, training=False):
            chunks = [batch.rows(chosen) for chosen in torch.arange(len(batch)).split(CHUNK)]
            observed = (chunk.to(device_of(policy)).observation for chunk in chunks)
            params = [policy.head(policy.over_time(policy.encode(one))) for one in observed]
        found.append({name: torch.cat([one[name] for one in params]).cpu() for name in params[0]})
    with in_mode(policy, training=True):  # else a paper's head draws with its least deviation
        actions = [policy.head.sample(found[0], draws) for _ in range(SAMPLES)]
    ratios = [policy.head.log_prob(found[0], a) - policy.head.log_prob(found[1], a) for a in actions]
    return float(torch.stack(ratios).double().mean())


def swap(
    policy: HistoryPolicy,
    task: int,
    then: Weights,
    now: Weights,
    parts: Mapping[str, list[str]],
    measure: Measure,
    name: str,
) -> Swap:
    """Measure the present weights, those of then, and the present ones with one part of then put back."""

    def measured(weights: Weights) -> float:
        with acting_with(policy, weights):
            return measure(policy)

    swapped = {part: measured({**now, **{n: then[n] for n in names}}) for part, names in parts.items()}
    return Swap(task, name, measured(then), measured(now), swapped)
