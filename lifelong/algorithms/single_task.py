"""A separate policy for each task: no transfer, no forgetting."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm, acting_with
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy, copy_weights


class SingleTask(Algorithm):
    """Train every task from the run's initial weights, and act on it with the weights learned for it.

    The reference for what a task yields by itself: zero-shot success on the diagonal is that of an untrained
    policy, and columns of the success matrix are constant. The weights of all tasks are kept in memory and in every
    checkpoint.
    """

    acts_by_weights = True
    state_form = {"initial": (None, Weights(complete=True)), "learned": {int: Weights(complete=True)}}

    def __init__(self) -> None:
        self.initial: dict[str, Tensor] | None = None
        self.learned: dict[int, dict[str, Tensor]] = {}  # position -> weights and buffers

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Restore the initial weights; at the first task, store them."""
        if self.initial is None:
            self.initial = copy_weights(policy)
        policy.load_state_dict(self.initial)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store the task's weights."""
        self.learned[task_index] = copy_weights(policy)

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with the task's own weights, or unchanged while the task is not learned."""
        with acting_with(policy, self.learned.get(task_index, {})):
            yield policy
