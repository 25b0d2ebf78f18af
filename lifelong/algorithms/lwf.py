"""Learning without forgetting."""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows, instructions_of
from lifelong.policies.base import Policy, copy_weights, device_of
from lifelong.types import Batch, NonNegative, to_device

P = TypeVar("P", bound=Policy)


class Teacher:
    """Frozen copy of a policy, in evaluation mode; it is built when it is first asked.

    Attributes:
        weights: Its weights and buffers by name; empty before the first task ends.
    """

    def __init__(self) -> None:
        self.weights: dict[str, Tensor] = {}
        self._policy: Any = None

    def become(self, weights: Mapping[str, Tensor]) -> None:
        """Take over weights."""
        self.weights, self._policy = dict(weights), None

    def state_dict(self) -> dict[str, Tensor]:
        """Return its weights."""
        return dict(self.weights)

    def load_state_dict(self, state: Mapping[str, Tensor], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned."""
        self.become(state)

    def like(self, policy: P) -> P:
        """Return the teacher, which is a policy of the same form as the given one."""
        if self._policy is None:
            self._policy = copy.deepcopy(policy).eval().requires_grad_(False)
            self._policy.load_state_dict(self.weights)
        return self._policy  # type: ignore[no-any-return]


class LwF(Algorithm):
    """On the new task's windows, respond to old instructions as the policy before the task did.

    The loss gains `strength * D(h_old(x, l), h(x, l))`, with x the new task's observations, l the
    instruction of an earlier task drawn for each window, h the policy's distribution of actions, h_old that
    of the frozen weights at the end of the last task and D the head's divergence: the squared distance of
    deterministic actions, a bound of the Kullback-Leibler divergence of mixtures. Li and Hoiem 2016, "Learning without
    forgetting" (section 3), distil the old tasks' output layers on the new task's images; a policy with an instruction
    has one output layer, and the instruction takes the place of the choice among them. No data are kept. Observations
    are not augmented in this term.

    With `instruction="own"`, l is the new task's own instruction: self-distillation, which holds the policy near what
    it would have done on what is seen now. No instruction of an earlier task is needed.
    """

    state_form = {"teacher": Weights(), "languages": {int: Tensor}}
    tuned = {"strength": (0.03, 0.1, 0.3, 1.0, 3.0)}
    plain_start = True

    def __init__(self, *, strength: NonNegative = 3.0, instruction: Literal["earlier", "own"] = "earlier"):
        """Create the algorithm.

        Args:
            strength: Weight of the divergence, which is averaged over steps and windows. At 3 the squared distance,
                summed over an action's dimensions, weighs errors of 0.05 as the absolute error of a deterministic
                head does (3 * 7 * 0.05^2 = 0.05). The divergence of mixtures has the unit of their loss: 1 weighs
                both alike.
            instruction: Instruction with which both are asked: those of earlier tasks, or the window's own.
        """
        self.strength, self.own = strength, instruction == "own"
        self.teacher = Teacher()
        self.languages: dict[int, Tensor] = {}  # last task of each learned stage -> its instructions, (n, L)
        self.distilled: Batch | None = None  # made by `mix`, used by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch unchanged; earlier instructions are drawn for a copy of it."""
        if self.languages and self.own:
            self.distilled = batch
        elif self.languages:
            languages = torch.cat(list(self.languages.values()))
            drawn = torch.randint(len(languages), (len(batch),), generator=generator)
            language = languages[to_device(drawn, languages.device)].to(batch.observation.language)
            self.distilled = replace(batch, observation=replace(batch.observation, language=language))
        return batch

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `strength * D(h_old, h)`, a scalar; None during the first task."""
        if self.distilled is None:
            return None
        batch, self.distilled = self.distilled.to(device_of(policy)), None
        with torch.no_grad():
            teacher = self.teacher.like(policy).answers(batch)
        return self.strength * policy.divergence(batch, teacher).mean()

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Make the present weights the teacher's, and add the task's instructions to the earlier ones."""
        self.teacher.become(copy_weights(policy))
        self.languages[task_index] = instructions_of(dataset)
