"""Online elastic weight consolidation."""

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm, WindowDataset, as_libero
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy


class EWC(Algorithm):
    """Pull each weight towards its last anchor, as hard as it mattered for the tasks so far.

    The loss gains `strength * sum_i F_i (theta_i - anchor_i)^2`, and after each task
    `F <- gamma * F + F_task` (Kirkpatrick et al. 2017, eq. 3; Schwarz et al. 2018, section 4, the online
    form; no factor 1/2, as in LIBERO).

    Two estimates of `F_task`, the diagonal of the Fisher information:

    * `per_sample`: the mean over windows of the squared gradient of one window's loss, in evaluation mode.
      It does not depend on the batch size. `strength` 1500 goes with it.
    * `batch`: the mean over batches of the squared gradient of the batch's mean loss, in training mode: what
      LIBERO does. Its expectation near an optimum is the per-sample one divided by the batch size, so the
      published strength of 5e4 at batch size 32 corresponds to about 5e4 / 32 = 1500 per sample.

    With `compat="libero"` what is not given is as in LIBERO's code: the batch estimate over all windows, augmented,
    and 5e4. With that go the results of Liu et al., table 8 (FWT / NBT / AUC of ResNet-T: LONG .13 / .22 / .02,
    SPATIAL .23 / .33 / .06, OBJECT .56 / .69 / .16, GOAL .32 / .48 / .06).
    """

    def __init__(
        self,
        *,
        strength: float | None = None,
        gamma: float = 0.9,
        fisher: Literal["per_sample", "batch"] | None = None,
        fisher_windows: int | None = None,
        fisher_batch_size: int = 32,
        compat: str | None = None,
    ):
        """Make the algorithm.

        Args:
            strength: Weight of the penalty (lambda); None: 1500 per sample, 5e4 with the batch estimate.
            gamma: What remains of the old Fisher information after each task.
            fisher: The estimate, see above; None: per sample, or as `compat` says.
            fisher_windows: How many windows, drawn without replacement, the estimate looks at; 0 means all. None:
                512, or as `compat` says.
            fisher_batch_size: Windows per batch of the `batch` estimate.
            compat: None, or `libero` for the choices of LIBERO's code.

        Raises:
            ConfigError: An unknown estimate, or another `compat`.
        """
        self.augments = as_libero(compat)
        if fisher is None:
            fisher = "batch" if self.augments else "per_sample"
        if fisher not in ("per_sample", "batch"):
            raise ConfigError(f"algo.fisher is {fisher!r}; valid: per_sample, batch")
        if fisher_windows is None:
            fisher_windows = 0 if self.augments else 512
        if strength is None:
            strength = 5e4 if fisher == "batch" else 1500.0
        self.strength = strength
        self.gamma = gamma
        self.fisher = fisher
        self.fisher_windows = fisher_windows
        self.fisher_batch_size = 1 if fisher == "per_sample" else fisher_batch_size
        self._importance: dict[str, Tensor] = {}
        self._anchor: dict[str, Tensor] = {}

    def penalty(self, policy: Policy) -> Tensor | None:
        """`strength * sum F (theta - anchor)^2`, a scalar; None before the first task is finished."""
        if not self._anchor:
            return None
        terms = [
            (self._importance[name] * (p - self._anchor[name]).square()).sum()
            for name, p in policy.named_parameters()
            if name in self._anchor
        ]
        return self.strength * torch.stack(terms).sum()

    def end_task(
        self, task_index: int, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's Fisher information and move the anchor to the present weights."""
        new = self.estimate(dataset, policy, generator)
        for name, value in new.items():
            old = self._importance.get(name)
            self._importance[name] = value if old is None else old.mul(self.gamma).add_(value)
        self._anchor = {n: p.detach().clone() for n, p in policy.named_parameters() if n in new}

    def estimate(
        self, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Diagonal Fisher information of the policy on a dataset: parameter name -> tensor of its shape."""
        count = len(dataset) if not self.fisher_windows else min(self.fisher_windows, len(dataset))
        order = torch.randperm(len(dataset), generator=generator)[:count]
        named = {n: p for n, p in policy.named_parameters() if p.requires_grad}
        total = {n: torch.zeros_like(p, memory_format=torch.preserve_format) for n, p in named.items()}
        device = next(iter(named.values())).device
        was_training = policy.training
        policy.train(self.fisher == "batch")
        steps = math.ceil(count / self.fisher_batch_size)
        for indices in order.split(self.fisher_batch_size):
            batch = dataset.batch(indices)
            if self.augments and self.augment is not None:
                batch = self.augment(batch, generator)
            loss = policy.loss(batch.to(device))
            grads = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
            for name, grad in zip(named, grads, strict=True):
                if grad is not None:
                    total[name].addcmul_(grad, grad, value=1 / steps)
        policy.train(was_training)
        return total

    def state_dict(self) -> dict[str, Any]:
        """Fisher information and anchor, by parameter name."""
        return {"importance": dict(self._importance), "anchor": dict(self._anchor)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave."""
        self._importance = dict(state["importance"])
        self._anchor = dict(state["anchor"])
