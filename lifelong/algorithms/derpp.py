"""Dark experience replay, with labels: DER++."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.data.memory import ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Batch

_CHUNK = 32  # windows predicted at a time at the end of a task


class DERpp(Algorithm):
    """Replay earlier windows with their demonstrated actions, and with what the policy answered back then.

    The loss is `L(present) + alpha E_M |z - h(x)|^2 + beta E_M L(x, y)` with independent draws from the
    memory M for the two expectations (Buzzega et al. 2020, "Dark experience for general continual learning",
    eq. 6). Here

    * h is the policy's deterministic action at every step of a window and z what it was at the end of the
      window's own task (there are no logits; tasks have known ends, so there is no reservoir along the way);
    * beta is `ratio`: replayed windows join the batch, as in ER, and all weigh the same in its mean;
    * |.|^2 is summed over an action's dimensions and averaged over steps and windows. Inputs are not
      augmented there: z was not.
    """

    def __init__(self, *, budget: int = 10_000, ratio: float = 1.0, alpha: float = 0.3):
        """Make the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks.
            ratio: Windows replayed for each window of the present task, and again as many for the outputs.
            alpha: Weight of the outputs. 3 would weigh errors of 0.05 as the absolute error of a deterministic
                head does (3 * 7 * 0.05^2 = 0.05), but larger ones, of tasks that are new, far more: 0.3 learned
                better and kept more (experiments/algorithms). For the likelihoods of a mixture the first
                reckoning gives about 50 (1 / (2 * 0.1^2)), a tenth of it 5; neither was tried.
        """
        self.ratio, self.alpha = ratio, alpha
        self.memory = ReplayMemory(budget)
        self._kept: dict[int, Tensor] = {}  # task -> (n,) windows in the memory
        self._outputs: dict[int, Tensor] = {}  # task -> (n, T, A), z of each of them
        self._recalled: Batch | None = None  # drawn by `mix`, used up by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch followed by `ratio` times as many windows of earlier tasks; others are drawn for z."""
        if not len(self.memory):
            return batch
        count = max(1, round(self.ratio * len(batch)))
        self._recalled = self.memory.sample(count, generator)
        return batch.join(self.memory.sample(count, generator))

    def penalty(self, policy: Policy) -> Tensor | None:
        """`alpha |z - h(x)|^2` on the windows drawn, a scalar; None during the first task."""
        if self._recalled is None:
            return None
        batch, self._recalled = self._recalled.to(_device(policy)), None
        distance = policy.predict(batch) - self.recall(batch)
        return self.alpha * distance.square().sum(-1).mean()

    def recall(self, batch: Batch) -> Tensor:
        """What the policy answered on windows of the memory when their tasks ended, (B, T, A)."""
        parts = batch.actions.new_empty(batch.actions.shape)
        for task, kept in self._kept.items():
            mine = batch.task_ids == task
            rows = (batch.window_ids[mine, None].to(kept.device) == kept).int().argmax(1)
            parts[mine] = self._outputs[task][rows].to(parts)
        return parts

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Take the task's windows in with what the policy answers on them."""
        self.memory.add(dataset, generator)
        before, self._kept = set(self._kept), self._held()
        for task, kept in self._kept.items():
            if task in before:  # a smaller share is the beginning of the larger one
                self._outputs[task] = self._outputs[task][: len(kept)].clone()
            else:
                self._outputs[task] = _answers(policy, dataset, kept)

    def state_dict(self) -> dict[str, Any]:
        """Which windows are kept, and the outputs stored with them: nothing later could compute these again."""
        return {"memory": self.memory.state_dict(), "outputs": dict(self._outputs)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Take up what `state_dict` gave; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], datasets)
        self._kept, self._outputs = self._held(), dict(state["outputs"])

    def _held(self) -> dict[int, Tensor]:
        return {int(task): kept for task, kept in self.memory.state_dict()["indices"].items()}


@torch.no_grad()
def _answers(policy: Policy, dataset: TaskWindows, windows: Tensor) -> Tensor:
    """The policy's actions on windows, in evaluation mode, (n, T, A)."""
    was_training, device = policy.training, _device(policy)
    policy.eval()
    parts = [policy.predict(dataset.batch(i).to(device)).float() for i in windows.split(_CHUNK)]
    policy.train(was_training)
    return torch.cat(parts)


def _device(policy: Policy) -> torch.device:
    return next(policy.parameters()).device
