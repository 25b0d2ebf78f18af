"""Dark experience replay, with labels: DER++."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.data.memory import MEMORY_FORM, ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.types import Batch, Count, NonNegative, Positive, to_device

_CHUNK = 32  # windows per forward pass at the end of a task


class DERpp(Rehearsal):
    """Replay earlier windows with their demonstrated actions, and with the policy's outputs of that time.

    The loss is `L(present) + alpha E_M D(z, h(x)) + beta E_M L(x, y)` with independent draws from the
    memory M for the two expectations (Buzzega et al. 2020, "Dark experience for general continual learning",
    eq. 6). Here

    * h is the policy's distribution of actions at every step of a window and z what it was at the end of the
      window's task (there are no logits; the ends of tasks are known, so no reservoir is needed);
    * beta is `ratio`: replayed windows join the batch, as in ER, and all weigh the same in its mean;
    * D is the head's divergence, in place of the paper's |z - h(x)|^2 of logits: the squared distance of deterministic
      actions, a bound of the Kullback-Leibler divergence of mixtures. It is averaged over steps and windows. Inputs
      are not augmented there: z was not.
    """

    state_form = {"memory": MEMORY_FORM, "outputs": {int: {str: Tensor}}}
    tuned = {"alpha": (0.01, 0.03, 0.1, 0.3, 1.0), "ratio": (0.5, 1.0, 2.0)}

    def __init__(self, *, budget: Count = 10_000, ratio: Positive = 1.0, alpha: NonNegative = 0.3):
        """Create the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks.
            ratio: Number of windows replayed for each window of the present task, and the same number for outputs.
            alpha: Weight of the outputs. 3 would weigh errors of 0.05 as the absolute error of a deterministic
                head does (3 * 7 * 0.05^2 = 0.05), but larger ones, of new tasks, far more: of the
                values tried, 0.03 was best with that head (experiments/tuning). The divergence of mixtures has
                the unit of their loss.
        """
        super().__init__(ReplayMemory(budget), ratio)
        self.alpha = alpha
        self._kept: dict[int, Tensor] = {}  # task -> (n,) windows in the memory
        self.outputs: dict[int, dict[str, Tensor]] = {}  # task -> z of each of them, each (n, T, ...)
        self._replayed: Batch | None = None  # drawn by `mix`, used by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by `ratio` times as many earlier windows; others are drawn for the outputs."""
        if not len(self.memory):
            return batch
        self._replayed = self._drawn(batch, generator)
        return batch.join(self._drawn(batch, generator))

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `alpha D(z, h(x))` on the drawn windows, a scalar; None during the first task."""
        if self._replayed is None:
            return None
        batch, self._replayed = self._replayed.to(device_of(policy)), None
        return self.alpha * policy.divergence(batch, self.stored_outputs(batch)).mean()

    def stored_outputs(self, batch: Batch) -> dict[str, Tensor]:
        """Return the policy's answers on windows of the memory at the end of their tasks, each (B, T, ...)."""
        outputs: dict[str, Tensor] = {}
        for task, kept in self._kept.items():
            self._kept[task] = kept = to_device(kept, batch.window_ids.device)
            if not len(kept):  # its share of the budget
                continue
            rows = (batch.window_ids[:, None] == kept).int().argmax(1)
            for name, values in self.outputs[task].items():
                found = values[rows].to(batch.actions)
                mine = (batch.task_ids == task).view(-1, *(1,) * (found.dim() - 1))
                outputs[name] = torch.where(mine, found, outputs.get(name, found))
        return outputs

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's windows to the memory, with the policy's outputs on them."""
        super().end_task(task_index, dataset, policy, generator)
        before, self._kept = set(self._kept), dict(self.memory.tasks)
        for task, kept in self._kept.items():
            if task in before:  # a smaller share is a prefix of the larger one
                self.outputs[task] = {n: z[: len(kept)].clone() for n, z in self.outputs[task].items()}
            else:
                self.outputs[task] = _outputs(policy, dataset, kept)

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned; the frames come from the datasets."""
        super().load_state_dict(state, datasets)
        self._kept = dict(self.memory.tasks)


@torch.no_grad()
def _outputs(policy: Policy, dataset: TaskWindows, windows: Tensor) -> dict[str, Tensor]:
    """Return the policy's answers on windows, in evaluation mode, each (n, T, ...)."""
    with in_mode(policy, training=False):
        parts = [policy.answers(dataset.batch(i).to(device_of(policy))) for i in windows.split(_CHUNK)]
    return {name: torch.cat([part[name].float() for part in parts]) for name in parts[0]}
