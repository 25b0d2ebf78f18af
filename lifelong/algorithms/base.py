"""The hooks through which an algorithm acts on training; the defaults are plain fine-tuning.

They are called in this order. `set_augmentation` comes once, before all others; the rest for every task (or every
stage of `stages`):

    begin_task
      for each of phases():  begin_phase, trained
                             per step: mix -> (policy loss) + penalty -> after_backward -> after_step
                             end_phase          with the phase's best weights loaded
    end_task
    policy_for                                  around every rollout
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Batch


@dataclass(frozen=True)
class Phase:
    """One stretch of training on a task.

    Attributes:
        name: Stands in the records and in checkpoint file names.
        share: Epochs of this phase as a share of the configured epochs.
        measures_transfer: Whether success during this phase is the learning curve of forward transfer.
    """

    name: str = "train"
    share: float = 1.0
    measures_transfer: bool = True


class Algorithm:
    """Sequential fine-tuning; a base for algorithms, which override the hooks they need.

    Attributes:
        augment: Augmentation of training batches, for algorithms that also apply it elsewhere; None for no
            augmentation.
    """

    augment: Callable[[Batch, torch.Generator], Batch] | None = None

    def set_augmentation(self, augment: Callable[[Batch, torch.Generator], Batch] | None) -> None:
        """Receive the augmentation of training batches, before any other hook and also when a run is resumed."""
        self.augment = augment

    def stages(self, tasks: int) -> tuple[tuple[int, ...], ...]:
        """Which tasks are learned together, stage after stage: by default one at a time.

        Elsewhere (in the other hooks, in records and file names) a stage goes by its last task.
        """
        return tuple((task,) for task in range(tasks))

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Before the first step on a task (position `task_index` in the sequence)."""

    def phases(self) -> tuple[Phase, ...]:
        """The stretches of training every task goes through, in order."""
        return (Phase(),)

    def begin_phase(self, phase: Phase, policy: Policy) -> None:
        """Before the first step of a phase; not called again when a killed run goes on inside it."""

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """What the optimiser moves and whose gradient is clipped, always in the same order.

        Asked for before the first step of a phase, and again when a killed run goes on inside it. An algorithm may
        add parameters of its own, which it keeps in `state_dict`, and may switch off gradients of others.
        """
        return [p for p in policy.parameters() if p.requires_grad]

    def mode_train(self, policy: Policy) -> None:
        """Put the policy in training mode; an algorithm may keep some layers in evaluation mode."""
        policy.train()

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch the loss is taken on: what came from the task's data, plus what the algorithm adds."""
        return batch

    def penalty(self, policy: Policy) -> Tensor | None:
        """A scalar added to the loss, or None; computed in the precision of the loss."""
        return None

    def after_backward(self, policy: Policy) -> None:
        """With gradients in place, before they are clipped; in the precision of the loss."""

    def after_step(self, policy: Policy) -> None:
        """After the optimiser moved the weights."""

    def end_phase(self, phase: Phase, policy: Policy) -> None:
        """After the last step of a phase, with the weights that are kept."""

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """After training on a task, with the final weights."""

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Within the context, the policy that acts on a task; afterwards the policy is as before."""
        yield policy

    def state_dict(self) -> dict[str, Any]:
        """Everything that later tasks depend on: nested dictionaries of tensors, numbers and strings."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Take up what `state_dict` gave.

        Args:
            state: From `state_dict`.
            datasets: The windows of the tasks learned so far, by position; each is read when asked for.
        """
