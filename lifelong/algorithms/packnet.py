"""PackNet: every task owns a share of the weights, which later tasks do not change."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm, Phase, acting_with
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.nn.experts import freeze_statistics
from lifelong.policies.base import Policy
from lifelong.types import Positive

_log = logging.getLogger(__name__)
_DIVIDED = (nn.Linear, nn.Conv2d)  # layers whose weights LIBERO's code divides
_UNTRAINED = (nn.modules.batchnorm._BatchNorm, nn.LayerNorm)  # layers that it never trains


class PackNet(Algorithm):
    """Train the free weights, give the largest to the task, zero the rest, retrain (Mallya & Lazebnik 2018).

    Each parameter with two or more dimensions (convolutions, linear layers, embeddings, recurrent weights) is
    divided among the tasks, tensor by tensor. All others (biases, norms, their running statistics) learn with
    the first task and are then frozen. After each step of the optimiser, frozen values are restored, so weight
    decay and momentum cannot change them; a task's outputs stay bit-identical.

    With `masks_only` it is as in LIBERO's code, and outputs do change. Only weights of linear layers and convolutions
    are divided. Gradients of those that are not free are zeroed, and always those of these layers' biases and of
    batch and layer norms; weight decay still shrinks them all. Everything else (recurrent weights, group norms,
    embeddings) learns with every task. With that go the results of Liu et al., table 8 (FWT / NBT / AUC of ResNet-T:
    LONG .22 / .08 / .25, SPATIAL .55 / .07 / .63, OBJECT .60 / .17 / .60, GOAL .63 / .06 / .75). Gradients are
    clipped before they are zeroed, so what is frozen counts in their norm. One difference remains: there, retraining
    takes one epoch more and keeps the one with the best success of every fifth.
    """

    acts_by_weights = True
    state_form = {"task_index": int, "pruned": bool, "owner": Weights()}

    def __init__(
        self,
        *,
        prune_perc: Annotated[float, Field(gt=0, lt=1)] = 0.75,
        post_prune_share: Positive = 1.0,
        masks_only: bool = False,
    ):
        """Create the algorithm.

        Args:
            prune_perc: Share of the free weights that a task frees again when it ends; it keeps the rest.
            post_prune_share: Number of epochs of retraining after pruning, as a share of the epochs of training.
            masks_only: Whether to mask gradients only, as in LIBERO's code, instead of restoring frozen weights.
        """
        self.masks_only, self.prune_perc, self.post_prune_share = masks_only, prune_perc, post_prune_share
        self.task_index = 0
        self.pruned = False
        self.owner: dict[str, Tensor] = {}  # name -> uint8: 0 free, k + 1 owned by task k
        self._fixed: dict[str, Tensor] = {}  # name -> value that `after_step` restores
        self._movable: dict[str, Tensor] = {}  # name -> bool mask of the weights that may change

    def phases(self) -> tuple[Phase, ...]:
        """Return training of all free weights, then retraining of those the task keeps."""
        return (Phase("train"), Phase("retrain", self.post_prune_share, measures_transfer=False))

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Give the free weights to the new task."""
        self.task_index = task_index
        self.pruned = False
        divided = _layers(policy, _DIVIDED, "weight") if self.masks_only else None
        for name, p in policy.named_parameters():
            chosen = p.dim() >= 2 if divided is None else name in divided
            if p.requires_grad and chosen and name not in self.owner:
                self.owner[name] = torch.zeros(p.shape, dtype=torch.uint8, device=p.device)
        full = [name for name, owner in self.owner.items() if not bool((owner == 0).any())]
        if full:
            _log.warning(
                "PackNet: task %d has no free weight in %d of %d tensors (such as %s), whose weights earlier tasks "
                "own; a larger algo.prune_perc leaves more for later tasks",
                task_index + 1,
                len(full),
                len(self.owner),
                full[0],
            )

    def begin_phase(self, phase: Phase, policy: Policy) -> None:
        """Store which weights may change, and the values of the others."""
        self._freeze(policy)

    def count_trained(self, policy: Policy) -> int:
        """Count the weights that the task may change."""
        self._freeze_once(policy)
        return sum(
            int(self._movable[name].sum()) if name in self._movable else p.numel() * (name not in self._fixed)
            for name, p in policy.named_parameters()
            if p.requires_grad
        )

    def mode_train(self, policy: Policy) -> None:
        """Set training mode, with running statistics frozen after the first stage (`masks_only`: from the start)."""
        policy.train()
        if self.masks_only or self._has_earlier():
            freeze_statistics(policy)

    def after_backward(self, policy: Policy) -> None:
        """Zero the gradients of frozen weights, so that they do not count in the gradient's norm."""
        if not self.masks_only:
            self._zero_frozen(policy)

    def after_clipping(self, policy: Policy) -> None:
        """With `masks_only`, zero the gradients of frozen weights, which have counted in the gradient's norm."""
        if self.masks_only:
            self._zero_frozen(policy)

    def _zero_frozen(self, policy: Policy) -> None:
        self._freeze_once(policy)
        for name, p in policy.named_parameters():
            if p.grad is None:
                continue
            if name in self._movable:
                p.grad.mul_(self._movable[name])
            elif name in self._fixed:
                p.grad.zero_()

    @torch.no_grad()
    def after_step(self, policy: Policy) -> None:
        """Restore everything that the task may not change."""
        if self.masks_only:
            return
        self._freeze_once(policy)
        for name, tensor in _tensors(policy).items():
            if name in self._movable:
                torch.where(self._movable[name], tensor, self._fixed[name], out=tensor)
            elif name in self._fixed:
                tensor.copy_(self._fixed[name])

    @torch.no_grad()
    def end_phase(self, phase: Phase, policy: Policy) -> None:
        """After the first phase, give the largest free weights to the task and set the others to zero."""
        if self.pruned:
            return
        for name, p in policy.named_parameters():
            if name in self.owner:
                self._prune(p, self.owner[name])
        self.pruned = True

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with only the weights of the tasks up to `task_index`, as it was when that task ended."""
        if task_index > self.task_index or (task_index == self.task_index and not self.pruned):
            yield policy
            return
        acting = {
            name: p.detach().masked_fill((owner == 0) | (owner > task_index + 1), 0)
            for name, p in policy.named_parameters()
            if (owner := self.owner.get(name)) is not None
        }
        with acting_with(policy, acting):
            yield policy

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        super().load_state_dict(state, datasets)
        self._fixed, self._movable = {}, {}

    def _prune(self, weight: Tensor, owner: Tensor) -> None:
        free = (owner == 0).flatten().nonzero()[:, 0]
        keep = round(len(free) * (1 - self.prune_perc))
        if len(free) and not keep:
            keep = 1
        largest = weight.detach().flatten()[free].abs().topk(keep).indices
        flat = owner.flatten()
        flat[free[largest]] = self.task_index + 1
        owner.copy_(flat.view_as(owner))
        weight.masked_fill_(owner == 0, 0)

    def _freeze(self, policy: Policy) -> None:
        """Store the frozen values, which are those of the policy now: none has changed since the phase began."""
        self._fixed, self._movable = {}, {}
        target, later = self.task_index + 1 if self.pruned else 0, self._has_earlier()
        untrained = _layers(policy, _DIVIDED, "bias") | _layers(policy, _UNTRAINED, "weight", "bias")
        for name, tensor in _tensors(policy).items():
            if name in self.owner:
                if self.owner[name].shape != tensor.shape:
                    raise CheckpointError(
                        f"PackNet's owners of {name} have shape {tuple(self.owner[name].shape)}, the "
                        f"policy's {tuple(tensor.shape)}: the state belongs to another policy"
                    )
                self._movable[name] = self.owner[name] == target
                self._fixed[name] = tensor.detach().clone()
            elif name in untrained if self.masks_only else later:
                self._fixed[name] = tensor.detach().clone()

    def _has_earlier(self) -> bool:
        """Return whether weights belong to an earlier stage."""
        own = self.task_index + 1
        return any(bool(((owner > 0) & (owner != own)).any()) for owner in self.owner.values())

    def _freeze_once(self, policy: Policy) -> None:
        if not self._fixed:
            self._freeze(policy)


def _tensors(policy: Policy) -> dict[str, Tensor]:
    """Return parameters and buffers by name."""
    return dict(policy.named_parameters()) | dict(policy.named_buffers())


def _layers(policy: Policy, kinds: tuple[type[nn.Module], ...], *params: str) -> set[str]:
    """Return the names of the given parameters of all layers of some kinds."""
    names = [name for name, module in policy.named_modules() if isinstance(module, kinds)]
    return {f"{name}.{param}" for name in names for param in params}
