"""Learning without forgetting."""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Batch


class LwF(Algorithm):
    """On the new task's windows, answer the old instructions as the policy before it did.

    The loss gains `strength * |h_old(x, l) - h(x, l)|^2`, with x the new task's observations, l the
    instruction of an earlier task drawn for each window, h the policy's deterministic actions and h_old those
    of the frozen weights at the end of the last task. Li and Hoiem 2016, "Learning without forgetting"
    (section 3), distil the old tasks' output layers on the new task's images; a policy that is told the task has
    one output layer and the instruction in the place of the choice among them. No data are kept. Observations
    are not augmented in this term.
    """

    def __init__(self, *, strength: float = 3.0):
        """Make the algorithm.

        Args:
            strength: Weight of the distillation; the square is summed over an action's dimensions and
                averaged over steps and windows. 3 weighs errors of 0.05 as the absolute error of a
                deterministic head does (3 * 7 * 0.05^2 = 0.05); for the likelihoods of a mixture about 50, as
                1 / (2 * 0.1^2) makes the term the divergence of two Gaussians of deviation 0.1.
        """
        self.strength = strength
        self._weights: dict[str, Tensor] = {}  # of the teacher
        self._languages: dict[int, Tensor] = {}  # position of each task learned -> (L,)
        self._teacher: Policy | None = None
        self._asked: Batch | None = None  # made by `mix`, used up by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch as it is; earlier instructions are drawn for a copy of it."""
        if self._languages:
            drawn = torch.randint(len(self._languages), (len(batch),), generator=generator)
            languages = torch.stack(list(self._languages.values()))
            language = languages[drawn.to(languages.device)].to(batch.observation.language)
            self._asked = replace(batch, observation=replace(batch.observation, language=language))
        return batch

    def penalty(self, policy: Policy) -> Tensor | None:
        """`strength * |h_old - h|^2`, a scalar; None during the first task."""
        if self._asked is None:
            return None
        batch, self._asked = self._asked.to(next(policy.parameters()).device), None
        with torch.no_grad():
            answers = self._teach(policy).predict(batch)
        return self.strength * (policy.predict(batch) - answers).square().sum(-1).mean()

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """The present weights become the teacher's; the task's instruction joins the earlier ones."""
        self._weights = {n: t.detach().clone() for n, t in policy.state_dict().items()}
        self._teacher = None
        self._languages[task_index] = dataset.batch(torch.tensor([0])).observation.language[0].clone()

    def state_dict(self) -> dict[str, Any]:
        """The teacher's weights and the instructions learned."""
        return {"weights": dict(self._weights), "languages": dict(self._languages)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Take up what `state_dict` gave."""
        self._weights, self._languages = dict(state["weights"]), dict(state["languages"])
        self._teacher = None

    def _teach(self, policy: Policy) -> Policy:
        """The teacher, in evaluation mode; made when it is first asked for."""
        if self._teacher is None:
            self._teacher = copy.deepcopy(policy).eval().requires_grad_(False)
            self._teacher.load_state_dict(self._weights)
        return self._teacher
