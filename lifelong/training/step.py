"""One optimiser step, with its batch divided into micro-batches and over processes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy, device_of
from lifelong.training.distributed import Ranks
from lifelong.training.precision import autocast
from lifelong.training.settings import FitSettings
from lifelong.types import Batch

BatchAugmentation = Callable[[Batch, torch.Generator], Batch]


@dataclass(frozen=True)
class Step:
    """Moves the weights once, along the gradient of the policy's loss and the algorithm's penalty.

    Every rank is given the same batch and the same generator, so that all draw alike, and takes its rows after
    that. The loss of each micro-batch is weighted by its windows, so the gradient is that of the mean over the whole
    batch. Every rank computes the whole penalty and adds its share.

    Attributes:
        policy: Policy, trained in place.
        algorithm: Algorithm whose hooks are called; see `lifelong.algorithms.base`.
        optimizer: Optimiser of the parameters that the algorithm trains.
        settings: Number of micro-batches, precision, compilation and gradient clipping.
        augment: Augmentation of the mixed batch.
        ranks: Rank of this process among those that train together.
        loss_scale: Factor of the gradients before they are clipped.
        objective: Function from a batch to a scalar that is minimised in place of the policy's loss.

    Raises:
        ConfigError: The batch is divided, and the policy normalises over the batch.
    """

    policy: Policy
    algorithm: Algorithm
    optimizer: torch.optim.Optimizer
    settings: FitSettings
    augment: BatchAugmentation | None = None
    ranks: Ranks = Ranks()
    loss_scale: float = 1.0
    objective: Callable[[Batch], Tensor] | None = None

    def __post_init__(self) -> None:
        if self.settings.accumulate * self.ranks.size > 1:
            refuse_batch_norm(self.policy)

    def __call__(
        self, batch: Batch, generator: torch.Generator, lr: float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Make one step on a batch of the task's windows.

        Args:
            batch: Windows of the task, before replay and augmentation.
            generator: CPU generator for replay and augmentation.
            lr: Learning rate of this step. Default: that of the optimiser.

        Returns:
            This rank's share of the policy's loss and of the penalty; their sums over the ranks are the whole.
        """
        batch = self.algorithm.mix(batch, generator)
        if self.augment is not None:
            batch = self.augment(batch, generator)
        self.optimizer.zero_grad(set_to_none=True)
        total = torch.zeros((), device=self.device)
        for part in self._micro_batches(batch):
            if self._uses_cuda_graphs:
                torch.compiler.cudagraph_mark_step_begin()
            part = part.to(self.device)
            with self._autocast():
                loss = self._loss(part) * (len(part) / len(batch))
            (loss * self.loss_scale).backward()
            total = total + loss.detach().float()
            if self._uses_cuda_graphs and self.settings.accumulate > 1:
                self._copy_gradients()
        penalty = self._backward_penalty()
        self.ranks.sum_gradients(self._with_gradients())
        with self._autocast():
            self.algorithm.after_backward(self.policy)
        if self.algorithm.draws_after_backward and self.ranks.size > 1:
            self.ranks.synchronise([p.grad for p in self._with_gradients() if p.grad is not None])
        if self.settings.grad_clip:
            nn.utils.clip_grad_norm_(self._optimized, self.settings.grad_clip)
        self.algorithm.after_clipping(self.policy)
        for p in self._optimized:
            if p.grad is not None:
                p.grad = like(p, p.grad)
        for group in self.optimizer.param_groups if lr is not None else ():
            group["lr"] = lr * group.get("factor", 1.0)
        self.optimizer.step()
        self.algorithm.after_step(self.policy)
        return total, penalty

    def synchronise(self) -> None:
        """Give all ranks the first rank's weights and buffers."""
        tensors = (*self.policy.parameters(), *self.policy.buffers(), *self._optimized)
        self.ranks.synchronise(list({id(t): t for t in tensors}.values()))

    def _micro_batches(self, batch: Batch) -> Iterator[Batch]:
        """Yield the micro-batches of this rank; none is empty."""
        rows, count = self.ranks.local_rows(len(batch)), self.settings.accumulate
        edges = [rows.start + (rows.stop - rows.start) * k // count for k in range(count + 1)]
        for start, stop in pairwise(edges):
            if stop > start:
                yield batch if stop - start == len(batch) else batch.rows(slice(start, stop))

    def _backward_penalty(self) -> Tensor:
        """Add the gradients of this rank's share of the penalty, and return the share."""
        with self._autocast():
            penalty = self.algorithm.penalty(self.policy)
        if penalty is None:
            return torch.zeros((), device=self.device)
        share = penalty / self.ranks.size
        (share * self.loss_scale).backward()
        return share.detach().float()

    def _copy_gradients(self) -> None:
        """Copy gradients out of the CUDA graph's memory, which its next run overwrites."""
        for p in self._with_gradients():
            if p.grad is not None:
                p.grad = p.grad.clone()

    def _with_gradients(self) -> list[Tensor]:
        """Return all parameters that may have a gradient, in the same order on all ranks."""
        params = (*(p for p in self.policy.parameters() if p.requires_grad), *self._optimized)
        return list({id(p): p for p in params}.values())

    def _autocast(self) -> torch.autocast:
        return autocast(self.device, self.settings.precision)

    @cached_property
    def device(self) -> torch.device:
        """Device of the policy."""
        return device_of(self.policy)

    @cached_property
    def _optimized(self) -> list[Tensor]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    @cached_property
    def _loss(self) -> Callable[[Batch], Tensor]:
        mode, loss = self.settings.compile, self.objective or self.policy.loss
        if mode == "off":
            return loss
        return torch.compile(loss, mode=None if mode == "default" else mode)

    @property
    def _uses_cuda_graphs(self) -> bool:
        return self.settings.compile == "reduce-overhead" and self.device.type == "cuda"


def like(parameter: Tensor, value: Tensor) -> Tensor:
    """Return a tensor of a parameter's shape in its memory format, which a fused optimiser takes for granted."""
    return value if value.stride() == parameter.stride() else torch.empty_like(parameter).copy_(value)


def refuse_batch_norm(policy: nn.Module) -> None:
    """Raise a ConfigError if the policy normalises over the batch, which then must not be divided."""
    for name, module in policy.named_modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            raise ConfigError(
                f"{name} takes its statistics over the batch, which several processes or train.accumulate "
                "divide: use policy.encoder.norm=group, or one process and train.accumulate=1"
            )
