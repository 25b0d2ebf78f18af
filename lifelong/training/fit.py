"""The training loop of a task. The package has no other."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lifelong.algorithms.base import Algorithm
from lifelong.checkpoints import check, load_weights
from lifelong.data.windows import WindowDataset, batches_in_order
from lifelong.errors import CheckpointError, ConfigError, TrainingError
from lifelong.policies.base import Policy, device_of
from lifelong.seeding import generator, seeded
from lifelong.training.distributed import Ranks
from lifelong.training.precision import float32_products
from lifelong.training.settings import FitSettings
from lifelong.training.step import BatchAugmentation, Step, like
from lifelong.types import Batch

TrainStep = Callable[[Batch, torch.Generator, float], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class EpochEnd:
    """State of training at the end of an epoch.

    Attributes:
        epoch: Number of epochs done; 0 is before the first step.
        loss: Mean of the policy's loss over the epoch; NaN at epoch 0.
        penalty: Mean of the algorithm's penalty over the epoch.
        seconds: Wall-clock time of the epoch, [s].
        policy: Policy with the weights of this moment.
        optimizer: Optimiser of these weights.
        more: Further entries of the state.
    """

    epoch: int
    loss: float
    penalty: float
    seconds: float
    policy: Policy = field(repr=False)
    optimizer: torch.optim.Optimizer = field(repr=False)
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def state(self) -> dict[str, Any]:
        """Return what `fit(resume=...)` needs to continue from here."""
        return {
            "epoch": self.epoch,
            "loss": self.loss,
            "penalty": self.penalty,
            "policy": self.policy.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            **self.more,
        }


def fit(
    policy: Policy,
    dataset: WindowDataset,
    algorithm: Algorithm,
    *,
    settings: FitSettings,
    seed: Sequence[int],
    augment: BatchAugmentation | None = None,
    on_epoch: Callable[[EpochEnd], bool | None] = lambda end: None,
    resume: dict[str, Any] | None = None,
    progress: str | None = None,
    ranks: Ranks = Ranks(),  # noqa: B008 - frozen
    step: TrainStep | None = None,
    load: Callable[[Sequence[Tensor]], Iterable[Batch]] | None = None,
    objective: Callable[[Batch], Tensor] | None = None,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Train a policy on one task's windows, with the replay and the penalties of an algorithm.

    On one machine the result depends on the arguments alone: each epoch's randomness is derived from `seed`
    and the epoch, and the global generators are as before afterwards. A resumed call continues to the same bits as
    an uninterrupted one. Several processes with the same arguments arrive at the same weights; see
    `lifelong.training.distributed`.

    Args:
        policy: Policy, trained in place.
        algorithm: Algorithm whose hooks are called at each step. The caller has called `begin_phase`, or loaded
            the algorithm's state.
        settings: Epochs, batch size and optimiser.
        seed: Integers that identify this call within the run.
        augment: Augmentation of each mixed batch, with the epoch's generator.
        on_epoch: Function called at the end of each epoch, at epoch 0 too, and again for the epoch resumed from;
            training ends where it returns True.
        resume: State from `EpochEnd.state` to continue from.
        progress: Text before a progress bar with the remaining time; None for no bar.
        ranks: Rank of this process among those that train together.
        step: Function that moves the weights once, given a batch, the epoch's generator and the learning rate, and
            returns the loss and the penalty. Default: `Step` with AdamW.
        load: Function that returns the batches of an epoch, given the indices of each; it may read ahead. Default:
            those of `dataset.batch`, with the next one read ahead where frames are on disk.
        objective: Function from a batch to what `Step` minimises. Default: `policy.loss`.
        more: Further entries of `EpochEnd.state`.

    Raises:
        TrainingError: The dataset is empty, or the loss is not finite.
        ConfigError: The batch is divided, and the policy normalises over the batch.
    """
    if not len(dataset):
        raise TrainingError("the dataset has no windows: check that its demonstrations are not empty")
    device, size = device_of(policy), settings.batch_size
    trained, factors = algorithm.trained(policy), algorithm.rate_factors(policy)
    optimizer = _make_optimizer(trained, settings, algorithm.named_parameters(policy), factors)
    default_step = Step(policy, algorithm, optimizer, settings, augment, ranks, objective=objective)
    step, load = step or default_step, load or partial(batches_in_order, dataset)
    steps, windows = _epoch_size(len(dataset), settings)
    first, loss, penalty = 0, math.nan, 0.0
    if resume is not None:
        load_weights(policy, resume["policy"], "the training state")
        _load_optimizer(optimizer, resume["optimizer"])
        first, loss, penalty = resume["epoch"], resume["loss"], resume["penalty"]
    elif settings.statistics_first:
        with seeded(*seed, 0, 2, device=device), float32_products(settings.precision):
            _adapt_statistics(policy, dataset, algorithm, size, augment, generator(*seed, 0, 3))
    own_draws = () if ranks.first else (ranks.rank,)  # dropout differs between ranks
    ended = on_epoch(EpochEnd(first, loss, penalty, 0.0, policy, optimizer, more or {}))
    make_bar = partial(tqdm, desc=progress, disable=progress is None, unit="step", leave=False)
    total = settings.epochs * steps
    with make_bar(total=total, initial=first * steps) as bar:
        for epoch in () if ended else range(first, settings.epochs):
            began, draws = time.perf_counter(), generator(*seed, epoch, 0)
            order = _shuffled_indices(len(dataset), windows, draws)
            default_step.synchronise()
            algorithm.mode_train(policy)
            rates = (learning_rate(n, total, settings, epoch * steps) for n in count(epoch * steps))
            with seeded(*seed, epoch, 1, *own_draws, device=device), float32_products(settings.precision):
                losses = _take_steps(step, load(order.split(size)), rates, draws, bar)
            loss, penalty = ranks.sum(losses.mean(0)).tolist()  # NaN without a step
            if len(losses) and not math.isfinite(loss):
                raise TrainingError(
                    f"the loss is {loss}: lower train.lr or algo.strength, or set train.precision=fp32"
                )
            bar.set_postfix(loss=f"{loss:.3f}", refresh=False)
            seconds = time.perf_counter() - began
            if on_epoch(EpochEnd(epoch + 1, loss, penalty, seconds, policy, optimizer, more or {})):
                break


def _take_steps(
    step: TrainStep, batches: Iterable[Batch], rates: Iterator[float], draws: torch.Generator, bar: tqdm
) -> Tensor:
    """Make a step with each batch; return the policy's loss and the penalty of each, (steps, 2)."""
    losses = []
    for batch in batches:
        losses.append(torch.stack(step(batch, draws, next(rates))))
        bar.update()
    return torch.stack(losses) if losses else torch.zeros(0, 2)


def _epoch_size(windows: int, settings: FitSettings) -> tuple[int, int]:
    """Return the number of steps of an epoch, and of the windows they take."""
    steps = settings.steps_per_epoch or math.ceil(windows / settings.batch_size)
    short = settings.last_batch == "short" and not settings.steps_per_epoch
    return steps, windows if short else steps * settings.batch_size


def check_warmup(settings: FitSettings, algorithm: Algorithm, windows: int) -> None:
    """Check that the warm-up ends before training does.

    Args:
        windows: Number of windows of the smallest stage, which counts where an epoch is a pass over them.

    Raises:
        ConfigError: The learning rate would never be `train.lr`.
    """
    for phase in algorithm.phases() if settings.warmup_steps else ():
        steps = max(1, round(settings.epochs * phase.share)) * _epoch_size(windows, settings)[0]
        if settings.warmup_steps > steps:
            raise ConfigError(
                f"train.warmup_steps is {settings.warmup_steps}, and a task has {steps} steps: the learning rate would "
                "never be train.lr; lower it, or raise train.epochs"
            )


def learning_rate(step: int, total: int, settings: FitSettings, epoch_start: int = 0) -> float:
    """Return the learning rate of a step: linear warm-up, then half a cosine from `lr` towards `lr_min`.

    Args:
        step: Number of the step within the task, from 0.
        total: Number of steps of the task.
        settings: Learning rates and warm-up.
        epoch_start: First step of the epoch, whose place on the cosine counts with `lr_every` of `epoch`.
    """
    if step < settings.warmup_steps:
        return settings.lr * (step + 1) / settings.warmup_steps
    if settings.lr_every == "epoch":
        step = max(epoch_start, settings.warmup_steps)
    share = (step - settings.warmup_steps) / max(1, total - settings.warmup_steps)
    return settings.lr_min + (settings.lr - settings.lr_min) * 0.5 * (1 + math.cos(math.pi * share))


@torch.no_grad()
def _adapt_statistics(
    policy: Policy,
    dataset: WindowDataset,
    algorithm: Algorithm,
    size: int,
    augment: BatchAugmentation | None,
    draws: torch.Generator,
) -> None:
    """Pass all windows through the policy in training mode, which moves BatchNorm's running statistics only."""
    algorithm.mode_train(policy)
    if not any(isinstance(m, nn.modules.batchnorm._BatchNorm) and m.training for m in policy.modules()):
        return
    for indices in torch.randperm(len(dataset), generator=draws).split(size):
        batch = dataset.batch(indices)
        policy.loss((batch if augment is None else augment(batch, draws)).to(device_of(policy)))


def _shuffled_indices(windows: int, count: int, draws: torch.Generator) -> Tensor:
    """Return (count,) indices of windows: permutations of all windows, concatenated and truncated."""
    rounds = math.ceil(count / windows)
    order = torch.cat([torch.randperm(windows, generator=draws) for _ in range(rounds)])
    return order[:count]


def _make_optimizer(
    trained: list[nn.Parameter],
    settings: FitSettings,
    named: Iterable[tuple[str, nn.Parameter]],
    factors: Mapping[str, float],
) -> torch.optim.AdamW:
    """Return the optimiser; parameters with the same factor of the learning rate are a group.

    On a CPU all parameters move in one fused loop, which takes weights, gradients and moments to lie alike in memory:
    see `Step` and `_load_optimizer`.
    """
    of_parameter = {
        id(parameter): factor
        for name, parameter in named
        for beginning, factor in factors.items()
        if name.startswith(beginning)
    }
    groups: dict[float, list[nn.Parameter]] = {}
    for parameter in trained:
        groups.setdefault(of_parameter.get(id(parameter), 1.0), []).append(parameter)
    return torch.optim.AdamW(
        [{"params": members, "factor": factor} for factor, members in groups.items()] if factors else trained,
        lr=settings.lr,
        betas=tuple(settings.betas),
        weight_decay=settings.weight_decay,
        fused=all(p.device.type == "cpu" and p.stride() == torch.empty_like(p).stride() for p in trained),
    )


def _load_optimizer(optimizer: torch.optim.AdamW, state: dict[str, Any]) -> None:
    """Load the state of an optimiser; raise CheckpointError where it is that of other parameters."""
    moments = {"step": Tensor, "exp_avg": Tensor, "exp_avg_sq": Tensor}
    check(state, {"state": {int: moments}, "param_groups": [dict]}, "the state of the optimiser")
    shapes = [p.shape for group in optimizer.param_groups for p in group["params"]]
    numbers = [group["params"] for group in optimizer.state_dict()["param_groups"]]
    fits = [group.get("params") for group in state["param_groups"]] == numbers and all(
        number in range(len(shapes)) and entry[name].shape == shapes[number]
        for number, entry in state["state"].items()
        for name in ("exp_avg", "exp_avg_sq")
    )
    if not fits:
        raise CheckpointError("the state of the optimiser belongs to other parameters than those of this run")
    optimizer.load_state_dict(state)
    for parameter, entry in optimizer.state.items():  # as in an uninterrupted run
        entry["step"] = entry["step"].cpu()
        for name in ("exp_avg", "exp_avg_sq"):
            entry[name] = like(parameter, entry[name])
