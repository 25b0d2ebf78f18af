"""PackNet: every task owns a share of the weights, which nothing later moves."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm, Phase, WindowDataset
from lifelong.errors import CheckpointError, ConfigError
from lifelong.policies.base import Policy

_NORMS = (nn.modules.batchnorm._BatchNorm, nn.modules.instancenorm._InstanceNorm)


class PackNet(Algorithm):
    """Train the free weights, give the largest to the task, zero the rest, retrain (Mallya & Lazebnik 2018).

    Each parameter with two or more dimensions (convolutions, linear layers, embeddings, recurrent weights) is
    divided among the tasks, tensor by tensor. All others (biases, norms, their running statistics) learn with
    the first task and are then frozen. After each step of the optimiser, whatever is not free is put back,
    so weight decay and momentum cannot move it; a task's outputs stay bit-identical for ever.
    """

    def __init__(self, *, prune_perc: float = 0.75, post_prune_share: float = 1.0):
        """Make the algorithm.

        Args:
            prune_perc: Share of the free weights given back after a task; the task keeps the rest.
            post_prune_share: Epochs of retraining after pruning, as a share of the epochs of training.

        Raises:
            ConfigError: A share outside its range.
        """
        if not 0 < prune_perc < 1:
            raise ConfigError(f"algo.prune_perc is {prune_perc}; it must lie between 0 and 1, e.g. 0.75")
        self.prune_perc = prune_perc
        self.post_prune_share = post_prune_share
        self.task_index = 0
        self._pruned = False
        self._owner: dict[str, Tensor] = {}  # name -> uint8: 0 free, k + 1 owned by task k
        self._fixed: dict[str, Tensor] = {}  # name -> value that `after_step` puts back
        self._movable: dict[str, Tensor] = {}  # name -> bool mask of what the optimiser may move

    def phases(self) -> tuple[Phase, ...]:
        """Training on all free weights, then retraining of those the task keeps."""
        return (Phase("train"), Phase("retrain", self.post_prune_share, measures_transfer=False))

    def begin_task(self, task_index: int, dataset: WindowDataset, policy: Policy) -> None:
        """Open the free weights to the new task."""
        self.task_index = task_index
        self._pruned = False
        for name, p in policy.named_parameters():
            if p.requires_grad and p.dim() >= 2 and name not in self._owner:
                self._owner[name] = torch.zeros(p.shape, dtype=torch.uint8, device=p.device)

    def begin_phase(self, phase: Phase, policy: Policy) -> None:
        """Note which weights may move, and the values of the others."""
        self._hold(policy)

    def mode_train(self, policy: Policy) -> None:
        """Training mode, with running statistics frozen after the first task."""
        policy.train()
        if self.task_index > 0:
            for module in policy.modules():
                if isinstance(module, _NORMS):
                    module.eval()

    def after_backward(self, policy: Policy) -> None:
        """No gradient on frozen weights, so that they do not count in the gradient's norm."""
        self._ready(policy)
        for name, p in policy.named_parameters():
            if p.grad is None:
                continue
            if name in self._movable:
                p.grad.mul_(self._movable[name])
            elif name in self._fixed:
                p.grad.zero_()

    @torch.no_grad()
    def after_step(self, policy: Policy) -> None:
        """Put everything back that the task may not move."""
        self._ready(policy)
        for name, tensor in _tensors(policy).items():
            if name in self._movable:
                torch.where(self._movable[name], tensor, self._fixed[name], out=tensor)
            elif name in self._fixed:
                tensor.copy_(self._fixed[name])

    @torch.no_grad()
    def end_phase(self, phase: Phase, policy: Policy) -> None:
        """After the first phase: the largest free weights become the task's, the others zero."""
        if self._pruned:
            return
        for name, p in policy.named_parameters():
            if name in self._owner:
                self._prune(p, self._owner[name])
        self._pruned = True

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """The policy with only the weights of the tasks up to `task_index`, as it was when that one ended."""
        if task_index > self.task_index or (task_index == self.task_index and not self._pruned):
            yield policy
            return
        whole = {n: p.detach().clone() for n, p in policy.named_parameters() if n in self._owner}
        with torch.no_grad():
            for name, p in policy.named_parameters():
                if name in whole:
                    owner = self._owner[name]
                    p.masked_fill_((owner == 0) | (owner > task_index + 1), 0)
        try:
            yield policy
        finally:
            with torch.no_grad():
                for name, p in policy.named_parameters():
                    if name in whole:
                        p.copy_(whole[name])

    def state_dict(self) -> dict[str, Any]:
        """Owners of all weights, and where in the task it stands."""
        return {"task_index": self.task_index, "pruned": self._pruned, "owner": dict(self._owner)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave."""
        self.task_index = int(state["task_index"])
        self._pruned = bool(state["pruned"])
        self._owner = dict(state["owner"])
        self._fixed, self._movable = {}, {}

    def owned_share(self) -> list[float]:
        """Share of the divisible weights each task owns, in the order of the tasks."""
        size = sum(o.numel() for o in self._owner.values())
        tasks = range(1, self.task_index + 2)
        return [sum(int((o == k).sum()) for o in self._owner.values()) / size for k in tasks]

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

    def _hold(self, policy: Policy) -> None:
        """The frozen values are those the policy has now: nothing frozen has moved since the phase began."""
        self._fixed, self._movable = {}, {}
        target = self.task_index + 1 if self._pruned else 0
        for name, tensor in _tensors(policy).items():
            if name in self._owner:
                if self._owner[name].shape != tensor.shape:
                    raise CheckpointError(
                        f"PackNet's owners of {name} have shape {tuple(self._owner[name].shape)}, the "
                        f"policy's {tuple(tensor.shape)}: the state belongs to another policy"
                    )
                self._movable[name] = self._owner[name] == target
                self._fixed[name] = tensor.detach().clone()
            elif self.task_index > 0:
                self._fixed[name] = tensor.detach().clone()

    def _ready(self, policy: Policy) -> None:
        if not self._fixed:
            self._hold(policy)


def _tensors(policy: Policy) -> dict[str, Tensor]:
    """Parameters and buffers by name."""
    return dict(policy.named_parameters()) | dict(policy.named_buffers())
