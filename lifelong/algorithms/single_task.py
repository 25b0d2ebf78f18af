"""A separate policy for each task: no transfer, no forgetting."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
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
        self._initial: dict[str, Tensor] | None = None
        self._learned: dict[int, dict[str, Tensor]] = {}  # position -> weights and buffers

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Restore the initial weights; at the first task, store them."""
        if self._initial is None:
            self._initial = copy_weights(policy)
        policy.load_state_dict(self._initial)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store the task's weights."""
        self._learned[task_index] = copy_weights(policy)

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with the task's own weights, or unchanged while the task is not learned."""
        if task_index not in self._learned:
            yield policy
            return
        present = copy_weights(policy)
        policy.load_state_dict(self._learned[task_index])
        try:
            yield policy
        finally:
            policy.load_state_dict(present)

    def state_dict(self) -> dict[str, Any]:
        """Return the initial weights and those of every learned task."""
        return {"initial": self._initial, "learned": dict(self._learned)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        self._initial = state["initial"]
        self._learned = dict(state["learned"])
