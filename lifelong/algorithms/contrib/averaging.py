"""Weight averaging between tasks."""

from collections.abc import Mapping

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.nn.experts import matches, matching
from lifelong.policies.base import Policy, copy_weights
from lifelong.types import Natural, Share


class Averaging(Algorithm):
    """Fine-tune on each task, then move only part of the way to what was found.

    After task t the weights are `theta_t = (1 - a_t) theta_{t-1} + a_t theta*_t`, where theta*_t is what fine-tuning on
    the task ends with, from theta_{t-1} on. With `a_t = 1 / t` that is the mean of all solutions: mean-IMM (Lee et al.
    2017, arXiv:1703.08475) with equal shares of the tasks and weights transferred from one to the next. A constant
    share is an exponential average, continual model averaging (Marouf et al. 2024, arXiv:2312.08977); with one task
    after pretraining it is WiSE-FT (Wortsman et al. 2022, arXiv:2109.01903), and with several RETAIN (Yadav et al.
    2025, arXiv:2512.08333), which may give parts of a policy shares of their own (`parts`). No data are kept, and
    nothing is added to a step.

    An average is good for both tasks only where the loss is low along the straight line between the two weights. That
    is likelier the closer they are: after pretraining, at low rates, with few steps.

    Statistics of batch normalisation are averaged like weights. Izmailov et al. (2018, arXiv:1803.05407) compute them
    anew with the averaged weights instead, for which the data of all tasks would be needed.

    The learning curve, and with it forward transfer and the choice of the best epoch, is of the fine-tuned weights;
    the success matrix, its diagonal too, is of the averaged ones.
    """

    tuned = {"share": (0.25, 0.5, 0.7, 0.9)}
    state_form = {"tasks": int, "before": (None, Weights(complete=True))}

    def __init__(
        self, *, share: Share | None = None, parts: Mapping[str, Share] | None = None, base_tasks: Natural = 1
    ):
        """Create the algorithm.

        Args:
            share: Share of the new task's solution after each task, in [0, 1]. None: that which gives the mean over
                the solutions so far.
            parts: Other shares of some weights and buffers, by patterns of their names, of which the first that
                matches counts.
            base_tasks: Number of tasks (stages, where tasks are learned together) whose solution is taken whole; what
                the last of them ends with counts as the first solution. 0 for a pretrained policy, which counts as
                one.
        """
        self.share, self.base_tasks, self.tasks = share, base_tasks, 0
        self.parts = dict(parts or {})
        self.before: dict[str, Tensor] | None = None  # weights and buffers when the present task began

    def share_of(self, number: int) -> float:
        """Return the share that the solution of a task is given.

        Args:
            number: Number of the task, from 1.
        """
        later = number - self.base_tasks
        if later <= 0:
            return 1.0
        return 1 / (later + 1) if self.share is None else self.share

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Store the weights that the task begins with, unless the task's are taken whole."""
        for pattern in self.parts:
            matching(list(policy.state_dict()), [pattern], "weight", "algo.parts")
        if self.tasks + 1 > self.base_tasks:
            self.before = copy_weights(policy)

    @torch.no_grad()
    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Average the task's weights with those before it; numbers that are no weights stay as they are."""
        self.tasks += 1
        if self.before is None:
            return
        for name, value in policy.state_dict().items():  # shares memory with the policy
            if value.is_floating_point():
                own = (share for pattern, share in self.parts.items() if matches(name, [pattern]))
                value.copy_(torch.lerp(self.before[name], value, next(own, self.share_of(self.tasks))))
        self.before = None
