"""One step of the optimiser, however its batch is cut: into micro-batches, and over processes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy
from lifelong.training.distributed import Ranks
from lifelong.training.precision import autocast, compiled
from lifelong.types import Batch

if TYPE_CHECKING:
    from lifelong.training.settings import FitSettings

BatchAugmentation = Callable[[Batch, torch.Generator], Batch]


@dataclass(frozen=True)
class Step:
    """Mixes a batch, descends on its loss and the algorithm's penalty.

    Every rank is given the same batch and the same generator, so that all draw alike, and takes its rows after
    that. Each micro-batch's loss weighs as many windows as it has, so the gradient is that of the mean over the
    whole batch. The penalty is computed whole by every rank, each counting for its share.

    Attributes:
        policy: Trained in place.
        algorithm: Its hooks; see `lifelong.algorithms.base`.
        optimizer: Of what the algorithm trains.
        settings: How the batch is cut, in which precision it is computed, where the gradient is clipped.
        device: Where the policy is.
        augment: Applied to the mixed batch.
        ranks: This process among those that train together.

    Raises:
        ConfigError: The batch is cut, and the policy normalises over the batch.
    """

    policy: Policy
    algorithm: Algorithm
    optimizer: torch.optim.Optimizer
    settings: "FitSettings"
    device: torch.device
    augment: BatchAugmentation | None
    ranks: Ranks

    def __post_init__(self) -> None:
        if self.settings.accumulate * self.ranks.size > 1:
            refuse_batch_norm(self.policy)

    def __call__(self, batch: Batch, generator: torch.Generator, lr: float) -> tuple[Tensor, Tensor]:
        """Move the weights once.

        Returns:
            This rank's share of the policy's loss and of the penalty: their sums over the ranks are the whole.
        """
        batch = self.algorithm.mix(batch, generator)
        if self.augment is not None:
            batch = self.augment(batch, generator)
        self.optimizer.zero_grad(set_to_none=True)
        loss, penalty = self._descend(batch), self._penalise()
        self.ranks.sum_gradients(self._with_gradients())
        with self._autocast():
            self.algorithm.after_backward(self.policy)
        if self.settings.grad_clip:
            nn.utils.clip_grad_norm_(self._moved, self.settings.grad_clip)
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.optimizer.step()
        self.algorithm.after_step(self.policy)
        return loss, penalty

    def agree(self) -> None:
        """Make sure that all ranks have the same weights and buffers."""
        tensors = (*self.policy.parameters(), *self.policy.buffers(), *self._moved)
        self.ranks.agree(list({id(t): t for t in tensors}.values()))

    def _descend(self, batch: Batch) -> Tensor:
        """Gradients of this rank's rows, micro-batch by micro-batch; their share of the loss."""
        total = torch.zeros((), device=self.device)
        for part in self._parts(batch):
            if self._graphs:
                torch.compiler.cudagraph_mark_step_begin()
            part = part.to(self.device)
            with self._autocast():
                loss = self._loss(part) * (len(part) / len(batch))
            loss.backward()
            total = total + loss.detach().float()
            if self._graphs and self.settings.accumulate > 1:
                self._own_gradients()
        return total

    def _penalise(self) -> Tensor:
        """Gradients of this rank's share of the penalty; the share."""
        with self._autocast():
            penalty = self.algorithm.penalty(self.policy)
        if penalty is None:
            return torch.zeros((), device=self.device)
        share = penalty / self.ranks.size
        share.backward()
        return share.detach().float()

    def _parts(self, batch: Batch) -> Iterator[Batch]:
        """The micro-batches of this rank; none is empty."""
        mine, count = self.ranks.rows(len(batch)), self.settings.accumulate
        edges = [mine.start + (mine.stop - mine.start) * k // count for k in range(count + 1)]
        for start, stop in pairwise(edges):
            if stop > start:
                yield batch if stop - start == len(batch) else batch.rows(slice(start, stop))

    def _own_gradients(self) -> None:
        """Take gradients out of the graph's memory, which its next run overwrites."""
        for p in self._with_gradients():
            if p.grad is not None:
                p.grad = p.grad.clone()

    def _with_gradients(self) -> list[Tensor]:
        """Parameters that may have one: the policy's and what else is moved, in an order all ranks share."""
        params = (*(p for p in self.policy.parameters() if p.requires_grad), *self._moved)
        return list({id(p): p for p in params}.values())

    def _autocast(self) -> torch.autocast:
        return autocast(self.device, self.settings.precision)

    @cached_property
    def _moved(self) -> list[Tensor]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    @cached_property
    def _loss(self) -> Callable[[Batch], Tensor]:
        return compiled(self.policy.loss, self.settings.compile)

    @property
    def _graphs(self) -> bool:
        return self.settings.compile == "reduce-overhead" and self.device.type == "cuda"


def refuse_batch_norm(policy: nn.Module) -> None:
    """Raises ConfigError where a batch may not be cut, because the policy takes statistics over it."""
    for name, module in policy.named_modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            raise ConfigError(
                f"{name} takes its statistics over the batch, which several processes or train.accumulate cut "
                "into parts: use policy.norm=group, or one process and train.accumulate=1"
            )
