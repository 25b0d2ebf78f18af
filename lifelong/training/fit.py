"""The training loop: there is no other."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lifelong.algorithms.base import Algorithm, WindowDataset
from lifelong.checkpoints import load_weights
from lifelong.errors import TrainingError
from lifelong.policies.base import Policy
from lifelong.seeding import generator, seeded
from lifelong.training.distributed import Ranks
from lifelong.training.settings import FitSettings
from lifelong.training.step import BatchAugmentation, Step


@dataclass(frozen=True)
class EpochEnd:
    """What a caller learns at the end of an epoch.

    Attributes:
        epoch: Epochs done; 0 is before the first step.
        loss: Mean of the policy's loss over the epoch; nan at epoch 0.
        penalty: Mean of the algorithm's penalty.
        seconds: Wall-clock time of the epoch.
        state: Gives what `fit(resume=...)` needs to go on from here.
    """

    epoch: int
    loss: float
    penalty: float
    seconds: float
    state: Callable[[], dict[str, Any]]


def fit(
    policy: Policy,
    dataset: WindowDataset,
    algorithm: Algorithm,
    *,
    settings: FitSettings,
    seed: Sequence[int],
    device: torch.device | str = "cpu",
    augment: BatchAugmentation | None = None,
    on_epoch: Callable[[EpochEnd], None] | None = None,
    resume: dict[str, Any] | None = None,
    label: str = "",
    progress: bool = False,
    ranks: Ranks = Ranks(),  # noqa: B008 - frozen
) -> None:
    """Train a policy on one task's windows, with what the algorithm adds.

    On one machine the result depends on the arguments alone: each epoch's randomness is derived from `seed`
    and the epoch, and the global generators are as before afterwards. A call that takes up a state goes on to
    the same bits as one that never stopped. Several processes that call it alike come to the same weights; see
    `lifelong.training.distributed`.

    Args:
        policy: Trained in place; has `loss(batch) -> scalar`.
        dataset: The task's windows.
        algorithm: Its hooks are called at each step; the caller has called `begin_phase` (or loaded
            its state).
        settings: Epochs, batch size, optimiser.
        seed: Whole numbers that name this stretch of training.
        device: Where the policy is.
        augment: Applied to each mixed batch, with the epoch's generator.
        on_epoch: Called at the end of each epoch, at epoch 0 too, and once more for the epoch taken up.
        resume: A state from `EpochEnd.state`.
        label: Stands before the progress bar.
        progress: Show a progress bar with the time left.
        ranks: This process among those that train together.

    Raises:
        TrainingError: The dataset is empty, or the loss is not finite.
        ConfigError: The batch is cut into parts, and the policy normalises over the batch.
    """
    if not len(dataset):
        raise TrainingError("the dataset has no windows: check that its demonstrations are not empty")
    device = torch.device(device)
    steps = settings.steps_per_epoch or math.ceil(len(dataset) / settings.batch_size)
    optimizer = _optimizer(algorithm.trained(policy), settings)
    first, loss, penalty = 0, math.nan, 0.0
    if resume is not None:
        first, loss, penalty = _take_up(resume, policy, optimizer)
    step = Step(policy, algorithm, optimizer, settings, device, augment, ranks)
    total = settings.epochs * steps
    bar = tqdm(total=total, initial=first * steps, desc=label, disable=not progress, unit="step", leave=False)

    def end(epoch: int, seconds: float) -> None:
        if on_epoch is not None:
            state = lambda: _state(epoch, loss, penalty, policy, optimizer)  # noqa: E731
            on_epoch(EpochEnd(epoch, loss, penalty, seconds, state))

    with bar:
        end(first, 0.0)
        for epoch in range(first, settings.epochs):
            started = time.perf_counter()
            rate = lambda k, e=epoch: learning_rate(e * steps + k, total, settings)  # noqa: E731
            loss, penalty = _epoch(step, dataset, steps, (*seed, epoch), rate, bar)
            end(epoch + 1, time.perf_counter() - started)


def learning_rate(step: int, total: int, settings: FitSettings) -> float:
    """Linear warm-up, then half a cosine from `lr` to `lr_min` over the steps of the task."""
    if step < settings.warmup_steps:
        return settings.lr * (step + 1) / settings.warmup_steps
    share = (step - settings.warmup_steps) / max(1, total - settings.warmup_steps)
    return settings.lr_min + (settings.lr - settings.lr_min) * 0.5 * (1 + math.cos(math.pi * share))


def _epoch(
    step: Step,
    dataset: WindowDataset,
    steps: int,
    seed: Sequence[int],
    rate: Callable[[int], float],
    bar: tqdm,
) -> tuple[float, float]:
    """Mean loss and mean penalty of an epoch."""
    draws, ranks = generator(*seed, 0), step.ranks
    order = _order(len(dataset), steps * step.settings.batch_size, draws)
    terms = []
    step.agree()
    step.algorithm.mode_train(step.policy)
    alone = () if ranks.first else (ranks.rank,)
    with seeded(*seed, 1, *alone, device=step.device):  # for dropout
        for k, indices in enumerate(order.split(step.settings.batch_size)):
            terms.append(torch.stack(step(dataset.batch(indices), draws, rate(k))))
            bar.update()
    loss, penalty = ranks.sum(torch.stack(terms).mean(0)).tolist()
    if not math.isfinite(loss):
        raise TrainingError(
            f"the loss is {loss}: lower train.lr or algo.strength, or set train.precision=fp32"
        )
    bar.set_postfix(loss=f"{loss:.3f}", refresh=False)
    return loss, penalty


def _order(windows: int, wanted: int, draws: torch.Generator) -> Tensor:
    """Indices of an epoch: permutations one after the other, cut to the number wanted."""
    rounds = math.ceil(wanted / windows)
    order = torch.cat([torch.randperm(windows, generator=draws) for _ in range(rounds)])
    return order[:wanted]


def _optimizer(trained: list[nn.Parameter], settings: FitSettings) -> torch.optim.AdamW:
    return torch.optim.AdamW(
        trained, lr=settings.lr, betas=tuple(settings.betas), weight_decay=settings.weight_decay
    )


def _state(
    epoch: int, loss: float, penalty: float, policy: Policy, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    return {
        "epoch": epoch,
        "loss": loss,
        "penalty": penalty,
        "policy": policy.state_dict(),
        "optimizer": optimizer.state_dict(),
    }


def _take_up(
    state: dict[str, Any], policy: Policy, optimizer: torch.optim.Optimizer
) -> tuple[int, float, float]:
    load_weights(policy, state["policy"], "the training state")
    optimizer.load_state_dict(state["optimizer"])
    return state["epoch"], state["loss"], state["penalty"]
