"""Dark experience replay, with labels: DER++."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.data.memory import MEMORY_FORM, ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Batch, Count, NonNegative

_CHUNK = 32  # windows per forward pass at the end of a task


class DERpp(Algorithm):
    """Replay earlier windows with their demonstrated actions, and with the policy's outputs of that time.

    The loss is `L(present) + alpha E_M |z - h(x)|^2 + beta E_M L(x, y)` with independent draws from the
    memory M for the two expectations (Buzzega et al. 2020, "Dark experience for general continual learning",
    eq. 6). Here

    * h is the policy's deterministic action at every step of a window and z what it was at the end of the
      window's task (there are no logits; the ends of tasks are known, so no reservoir is needed);
    * beta is `ratio`: replayed windows join the batch, as in ER, and all weigh the same in its mean;
    * |.|^2 is summed over an action's dimensions and averaged over steps and windows. Inputs are not
      augmented there: z was not.
    """

    state_form = {"memory": MEMORY_FORM, "outputs": {int: Tensor}}

    def __init__(self, *, budget: Count = 10_000, ratio: NonNegative = 1.0, alpha: NonNegative = 0.3):
        """Create the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks.
            ratio: Number of windows replayed for each window of the present task, and the same number for outputs.
            alpha: Weight of the outputs. 3 would weigh errors of 0.05 as the absolute error of a deterministic
                head does (3 * 7 * 0.05^2 = 0.05), but larger ones, of new tasks, far more: 0.3 learned
                better and forgot less (experiments/algorithms). For the likelihoods of a mixture the same
                calculation gives about 50 (1 / (2 * 0.1^2)), a tenth of it 5; neither was tried.
        """
        self.ratio, self.alpha = ratio, alpha
        self.memory = ReplayMemory(budget)
        self._kept: dict[int, Tensor] = {}  # task -> (n,) windows in the memory
        self._outputs: dict[int, Tensor] = {}  # task -> (n, T, A), z of each of them
        self._replayed: Batch | None = None  # drawn by `mix`, used by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by `ratio` times as many earlier windows; others are drawn for the outputs."""
        if not len(self.memory):
            return batch
        count = max(1, round(self.ratio * len(batch)))
        self._replayed = self.memory.sample(count, generator)
        return batch.join(self.memory.sample(count, generator))

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `alpha |z - h(x)|^2` on the drawn windows, a scalar; None during the first task."""
        if self._replayed is None:
            return None
        batch, self._replayed = self._replayed.to(_device(policy)), None
        distance = policy.predict(batch) - self.stored_outputs(batch)
        return self.alpha * distance.square().sum(-1).mean()

    def stored_outputs(self, batch: Batch) -> Tensor:
        """Return the policy's outputs on windows of the memory at the end of their tasks, (B, T, A)."""
        parts = batch.actions.new_empty(batch.actions.shape)
        for task, kept in self._kept.items():
            mine = batch.task_ids == task
            rows = (batch.window_ids[mine, None].to(kept.device) == kept).int().argmax(1)
            parts[mine] = self._outputs[task][rows].to(parts)
        return parts

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's windows to the memory, with the policy's outputs on them."""
        self.memory.add(dataset, generator)
        before, self._kept = set(self._kept), self._held()
        for task, kept in self._kept.items():
            if task in before:  # a smaller share is a prefix of the larger one
                self._outputs[task] = self._outputs[task][: len(kept)].clone()
            else:
                self._outputs[task] = _outputs(policy, dataset, kept)

    def state_dict(self) -> dict[str, Any]:
        """Return which windows are kept, and their outputs, which cannot be computed again later."""
        return {"memory": self.memory.state_dict(), "outputs": dict(self._outputs)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], datasets)
        self._kept, self._outputs = self._held(), dict(state["outputs"])

    def _held(self) -> dict[int, Tensor]:
        return {int(task): kept for task, kept in self.memory.state_dict()["indices"].items()}


@torch.no_grad()
def _outputs(policy: Policy, dataset: TaskWindows, windows: Tensor) -> Tensor:
    """Return the policy's actions on windows, in evaluation mode, (n, T, A)."""
    was_training, device = policy.training, _device(policy)
    policy.eval()
    parts = [policy.predict(dataset.batch(i).to(device)).float() for i in windows.split(_CHUNK)]
    policy.train(was_training)
    return torch.cat(parts)


def _device(policy: Policy) -> torch.device:
    return next(policy.parameters()).device
