"""Averaged gradient episodic memory."""

import torch
from torch import Tensor

from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.data.memory import ReplayMemory
from lifelong.policies.base import Policy
from lifelong.types import Batch, Positive


class AGEM(Rehearsal):
    """Remove from each gradient the component that would raise the loss on a sample of earlier tasks.

    With g the gradient on the present task and g_ref that on windows drawn from the memory: where
    `g . g_ref < 0`, `g <- g - (g . g_ref / g_ref . g_ref) g_ref` (Chaudhry et al. 2019, "Efficient lifelong
    learning with A-GEM", eq. 11). The memory is ER's; its windows are used without augmentation.

    In behaviour cloning it forgets: one instruction-conditioned network learns similar tasks, so g and g_ref mostly
    agree and the constraint seldom acts; where it does, one batch's loss is kept from rising to first order. Nothing
    lowers a loss that has risen, as replay does.

    LIBERO's code has `FirstWindows` as memory and augments its windows. No results of that are published.
    """

    draws_after_backward = True
    adds_windows = False
    tuned = {"ratio": (0.5, 1.0, 2.0)}

    def __init__(self, *, memory: ReplayMemory, ratio: Positive = 1.0, augment_reference: bool = False):
        """Create the algorithm.

        Args:
            memory: Memory of earlier tasks' windows, `ReplayMemory` or `FirstWindows`.
            ratio: Number of reference windows for each window of the batch; more make g_ref less noisy.
            augment_reference: Whether the reference windows are augmented as in training.
        """
        super().__init__(memory, ratio)
        self.augment_reference = augment_reference
        self.reference: Batch | None = None  # drawn by `mix`, used by `after_backward`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch unchanged; the reference windows are drawn here."""
        if len(self.memory):
            self.reference = self._drawn(batch, generator)
            if self.augment_reference and self.augment is not None:
                self.reference = self.augment(self.reference, generator)
        return batch

    def after_backward(self, policy: Policy) -> None:
        """Project the gradient where it disagrees with the reference."""
        if self.reference is None:
            return
        params = [p for p in policy.parameters() if p.requires_grad]
        loss = policy.loss(self.reference.to(params[0].device))
        self.reference = None
        project(params, torch.autograd.grad(loss, params, allow_unused=True))


@torch.no_grad()
def project(params: list[Tensor], reference: tuple[Tensor | None, ...]) -> None:
    """Project the parameters' gradients so that their product with the reference is not negative.

    A missing gradient, on either side, counts as zero. Where the product is not negative, nothing changes.
    """
    used = [(p, r) for p, r in zip(params, reference, strict=True) if r is not None]
    products = [(p.grad * r).sum() for p, r in used if p.grad is not None]
    if not products:
        return
    product = torch.stack(products).sum()
    share = product / torch.stack([r.square().sum() for _, r in used]).sum()
    share = torch.where(product >= 0, 0.0, share)  # on the device: the host need not know it
    for p, r in used:
        if p.grad is not None:
            p.grad.sub_(share * r)
        elif share != 0:
            p.grad = -share * r
