"""Averaged gradient episodic memory."""

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm, WindowDataset, as_libero
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.memory import FirstWindows, ReplayMemory
from lifelong.policies.base import Policy
from lifelong.types import Batch


class AGEM(Algorithm):
    """Take out of each gradient what would raise the loss on a sample of earlier tasks.

    With g the gradient on the present task and g_ref that on windows drawn from the memory: where
    `g . g_ref < 0`, `g <- g - (g . g_ref / g_ref . g_ref) g_ref` (Chaudhry et al. 2019, "Efficient lifelong
    learning with A-GEM", eq. 11). The memory is ER's; its windows are taken without augmentation.

    With `compat="libero"` it is the memory of LIBERO's code (see `ER`), and its windows are augmented. No results of
    that are published.
    """

    def __init__(
        self, *, budget: int = 10_000, ratio: float = 1.0, per_task: int = 1000, compat: str | None = None
    ):
        """Make the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks; not used with `compat="libero"`.
            ratio: Windows of the reference for each window of the batch; more make g_ref less noisy.
            per_task: Windows kept of each task with `compat="libero"`; not used without.
            compat: None, or `libero` for the choices of LIBERO's code.

        Raises:
            ConfigError: Another `compat`.
        """
        self.ratio, self.compat = ratio, compat
        self.memory = FirstWindows(per_task) if as_libero(compat) else ReplayMemory(budget)
        self._reference: Batch | None = None  # drawn by `mix`, used up by `after_backward`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch as it is; the windows of the reference are drawn here."""
        if len(self.memory):
            self._reference = self.memory.sample(max(1, round(self.ratio * len(batch))), generator)
            if self.compat and self.augment is not None:
                self._reference = self.augment(self._reference, generator)
        return batch

    def after_backward(self, policy: Policy) -> None:
        """Project the gradient, unless it agrees with the reference already."""
        if self._reference is None:
            return
        params = [p for p in policy.parameters() if p.requires_grad]
        loss = policy.loss(self._reference.to(params[0].device))
        self._reference = None
        project(params, torch.autograd.grad(loss, params, allow_unused=True))

    def end_task(
        self, task_index: int, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> None:
        """Take the task's windows in; the earlier tasks' shares shrink."""
        self.memory.add(cast(SequenceVLDataset, dataset), generator)

    def state_dict(self) -> dict[str, Any]:
        """Which windows are kept; their frames are read again from the demonstrations."""
        return {"memory": self.memory.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], cast(Mapping[int, SequenceVLDataset], datasets))


@torch.no_grad()
def project(params: list[Tensor], reference: tuple[Tensor | None, ...]) -> None:
    """Make the parameters' gradients agree with the reference: no negative product is left.

    A missing gradient, on either side, counts as zero. Gradients that agree already are not touched.
    """
    used = [(p, r) for p, r in zip(params, reference, strict=True) if r is not None]
    products = [(p.grad * r).sum() for p, r in used if p.grad is not None]
    product = torch.stack(products).sum() if products else torch.zeros(())
    if product >= 0:
        return
    share = product / torch.stack([r.square().sum() for _, r in used]).sum()
    for p, r in used:
        if p.grad is None:
            p.grad = -share * r
        else:
            p.grad.sub_(share * r)
