"""The hooks through which an algorithm acts on training; the defaults are plain fine-tuning.

    hook                                              called
    set_augmentation(augment)                         once, before all others
    stages(tasks) -> stages                           once: which tasks are learned together
    begin_task(task_index, dataset, policy)           before the first step on a task
    phases() -> phases                                then, for the phases of the task
    begin_phase(phase, policy)                        before the first step of each phase
    trained(policy) -> parameters                     before the first step, and when a run resumes
    rate_factors(policy) -> factors                   then: the learning rates of parts of the policy
    mode_train(policy)                                before the steps of each epoch
    mix(batch, generator) -> batch                    each step, before the loss
    penalty(policy) -> scalar or None                 each step, after the loss
    after_backward(policy)                            each step, before gradients are clipped
    after_clipping(policy)                            each step, before the optimiser moves the weights
    after_step(policy)                                each step, after the optimiser moved the weights
    end_phase(phase, policy)                          after each phase, with the weights that are kept
    end_task(task_index, dataset, policy, generator)  after the last phase
    policy_for(task_index, policy) -> policy          around every rollout, as a context
    acting_state(task_index, policy) -> state         before a rollout: whether it would repeat another one
    state_dict() -> state                             when a checkpoint is written
    load_state_dict(state, datasets)                  when a run resumes

The hooks from `begin_task` to `end_task` are called for every task, or for every stage of `stages`, whose
`task_index` is that of its last task.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lifelong import checkpoints
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError, DataError
from lifelong.policies.base import Policy, has_hooks
from lifelong.types import Batch

Augmentation = Callable[[Batch, torch.Generator], Batch]


@dataclass(frozen=True)
class Phase:
    """Part of the training on a task.

    Attributes:
        name: Name in the records and in checkpoint file names.
        share: Number of epochs of this phase as a share of the configured epochs.
        measures_transfer: Whether success during this phase is the learning curve of forward transfer.
    """

    name: str = "train"
    share: float = 1.0
    measures_transfer: bool = True


class Algorithm:
    """Sequential fine-tuning, and the base of all algorithms, which override the hooks they need.

    The hooks and the order of their calls are listed at the top of this module.

    Attributes:
        augment: Augmentation of training batches, for algorithms that also apply it elsewhere; None for no
            augmentation.
        state_form: Form of the state, see `lifelong.checkpoints.check`. By default its keys are the attributes that
            `state_dict` returns. A state from a file is checked by it before `load_state_dict` gets it; that of a class
            with a `state_dict` of its own and no form is not checked.
        acts_by_weights: Whether `policy_for` of the same class changes values of the policy's parameters and buffers
            only.
        tuned: Settings that decide what is kept and what is learned, with the values that `libero tune` tries; the
            first is the one it varies unasked. They do not act before the `end_task` of the first task.
        plain_start: Whether the first task is learned as by fine-tuning, with no state before its `end_task`;
            `libero tune` then learns it once for all such algorithms.
        adds_windows: Whether `mix` adds windows of earlier tasks to batches.
        needs_demonstrations: Whether its hooks take a batch for windows of demonstrations, so that it cannot learn from
            reward.
        draws_after_backward: Whether `after_backward` draws at random, by dropout for instance: the gradients of the
            first rank are then those of all.

    Examples:
        An algorithm that keeps the weights of the last task close:

        >>> import torch
        >>> class L2(Algorithm):
        ...     def __init__(self, *, strength: float):
        ...         self.strength, self.anchor = strength, {}
        ...
        ...     def penalty(self, policy):
        ...         terms = [
        ...             (p - self.anchor[n]).square().sum() for n, p in policy.named_parameters() if n in self.anchor
        ...         ]
        ...         return self.strength * sum(terms) if terms else None
        ...
        ...     def end_task(self, task_index, dataset, policy, generator):
        ...         self.anchor = {n: p.detach().clone() for n, p in policy.named_parameters()}
        ...
        ...     def state_dict(self):
        ...         return {"anchor": self.anchor}
        ...
        ...     def load_state_dict(self, state, datasets):
        ...         self.anchor = dict(state["anchor"])
        >>> algorithm, policy = L2(strength=10.0), torch.nn.Linear(2, 2)
        >>> algorithm.penalty(policy) is None  # nothing is learned yet
        True
        >>> algorithm.end_task(0, None, policy, torch.Generator())
        >>> algorithm.penalty(policy).item()
        0.0
    """

    augment: Augmentation | None = None
    state_form: ClassVar[Any] = {}
    acts_by_weights: ClassVar[bool] = False
    tuned: Mapping[str, tuple[float, ...]] = {}
    plain_start: ClassVar[bool] = False
    adds_windows: ClassVar[bool] = False
    needs_demonstrations: ClassVar[bool] = False
    draws_after_backward: ClassVar[bool] = False

    def set_augmentation(self, augment: Augmentation | None) -> None:
        """Receive the augmentation of training batches, before any other hook and also when a run is resumed."""
        self.augment = augment

    def stages(self, tasks: int) -> tuple[tuple[int, ...], ...]:
        """Return which tasks are learned together, stage after stage; by default one at a time.

        In the other hooks, in records and in file names, a stage has the index of its last task.
        """
        return tuple((task,) for task in range(tasks))

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Prepare for a task, before the first step on it.

        Args:
            task_index: Position of the task in the task sequence.
            dataset: Windows of its demonstrations.
            policy: Policy with the weights that the last task ended with.
        """

    def phases(self) -> tuple[Phase, ...]:
        """Return the phases of training that every task goes through, in order: the same whenever it is asked."""
        return (Phase(),)

    def begin_phase(self, phase: Phase, policy: Policy) -> None:
        """Prepare for a phase, before its first step; not called again when a run resumes inside the phase."""

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the parameters that the optimiser moves and whose gradient is clipped, always in the same order.

        Called before the first step of a phase, and again when a run resumes inside it. An algorithm may add its own
        parameters, which it keeps in `state_dict`, and may switch off gradients of others.
        """
        return [p for p in policy.parameters() if p.requires_grad]

    def count_trained(self, policy: Policy) -> int:
        """Count the numbers that steps move: all of `trained`, unless the algorithm holds some of them."""
        return sum(p.numel() for p in self.trained(policy))

    def rate_factors(self, policy: Policy) -> Mapping[str, float]:
        """Return factors of the learning rate: beginning of parameters' names -> factor. By default the policy's."""
        return policy.rate_factors() if isinstance(policy, Policy) else {}

    def named_parameters(self, policy: Policy) -> Iterable[tuple[str, nn.Parameter]]:
        """Return the parameters that `trained` chooses from, with the names that `rate_factors` refers to."""
        return policy.named_parameters()

    def mode_train(self, policy: Policy) -> None:
        """Put the policy in training mode; an algorithm may keep some layers in evaluation mode."""
        policy.train()

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch that the loss is computed on: the task's windows, and what the algorithm adds.

        Args:
            batch: Windows of the present task, not augmented yet.
            generator: CPU generator of the step.
        """
        return batch

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return a scalar to add to the loss, or None; computed in the precision of the loss."""
        return None

    def after_backward(self, policy: Policy) -> None:
        """Change the gradients before they are clipped; in the precision of the loss."""

    def after_clipping(self, policy: Policy) -> None:
        """Change the gradients after they are clipped; what is removed here counts in their norm."""

    def after_step(self, policy: Policy) -> None:
        """Change the weights after the optimiser moved them."""

    def end_phase(self, phase: Phase, policy: Policy) -> None:
        """Finish a phase, after its last step, with the weights that are kept."""

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Finish a task, after its last phase.

        Args:
            task_index: Position of the task in the task sequence.
            dataset: Windows of its demonstrations.
            policy: Policy with the task's final weights.
            generator: CPU generator of the task's end.
        """

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy that acts on the task at `task_index`; after the context the policy is as before."""
        yield policy

    def acting_state(self, task_index: int, policy: Policy) -> Any:
        """Return what decides how the policy acts on a task besides the tensors of `policy_for`.

        Rollouts whose tensors, acting state and starts are those of earlier ones are not run again, so that what is
        frozen is measured once. By default nothing else decides with `acts_by_weights`, or where `policy_for` is as
        here and no layer has hooks; otherwise everything in `state_dict`, which is always right.

        Args:
            task_index: Position of the task in the task sequence.
            policy: Policy that `policy_for` yields for the task.

        Returns:
            Nested dictionaries of tensors, numbers and strings.
        """
        plain = type(self).policy_for is Algorithm.policy_for and not has_hooks(policy)
        owner = next(one for one in type(self).__mro__ if "policy_for" in vars(one))
        by_weights = self.acts_by_weights and "acts_by_weights" in vars(owner)
        return {} if plain or by_weights else self.state_dict()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that later tasks depend on: nested dictionaries of tensors, numbers and strings.

        By default the attributes that `state_form` names; of one with a `state_dict`, such as a memory, that.
        """
        return {name: _plain(getattr(self, name)) for name in self.state_form}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: State from `state_dict`.
            datasets: Windows of the tasks learned so far, by position; each is read when it is accessed.
        """
        for name in self.state_form:
            part = getattr(self, name)
            if hasattr(part, "load_state_dict"):
                part.load_state_dict(state[name], datasets)
            else:
                setattr(self, name, _plain(state[name]))


def _plain(part: Any) -> Any:
    if hasattr(part, "state_dict"):
        return part.state_dict()
    return dict(part) if isinstance(part, Mapping) else part


@contextmanager
def acting_with(policy: Policy, values: Mapping[str, Tensor]) -> Iterator[Policy]:
    """Yield the policy with other values of some parameters and buffers, by name, which it has back afterwards."""
    own = policy.state_dict()
    present = {name: own[name].clone() for name in values}
    put_weights(policy, values)
    try:
        yield policy
    finally:
        put_weights(policy, present)


@torch.no_grad()
def put_weights(policy: Policy, values: Mapping[str, Tensor]) -> None:
    """Set parameters and buffers of a policy, by name, in place."""
    own = policy.state_dict()  # which shares their memory
    for name, value in values.items():
        own[name].copy_(value)


def load_algorithm(
    algorithm: Algorithm,
    state: Mapping[str, Any],
    datasets: Mapping[int, TaskWindows],
    policy: Policy,
    source: Path,
) -> None:
    """Load an algorithm's state from a file.

    Args:
        algorithm: Algorithm to load into.
        state: State as the file has it.
        datasets: Windows of the tasks learned so far, by position.
        policy: Policy that the algorithm belongs to.
        source: The file, for error messages.

    Raises:
        CheckpointError: The state is that of another algorithm, or of another policy.
    """
    for kind in type(algorithm).__mro__:  # a class with a state_dict of its own may have another form
        if "state_form" in vars(kind):
            checkpoints.check(state, algorithm.state_form, f"{source}: the state of the algorithm", policy)
        if "state_form" in vars(kind) or "state_dict" in vars(kind):
            break
    try:
        algorithm.load_state_dict(state, datasets)
    except DataError as error:
        raise CheckpointError(f"{source}: {error}") from error
