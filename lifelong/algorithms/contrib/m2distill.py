"""Replay with distillation of every modality's features and of the action distribution."""

import torch
from torch import Tensor

from lifelong.algorithms.lwf import Teacher
from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.checkpoints import Weights
from lifelong.data.memory import MEMORY_FORM, ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy, copy_weights, device_of
from lifelong.policies.history import HistoryPolicy, with_features
from lifelong.types import Batch, Count, NonNegative, Observation, Positive

_NOT_IMAGES = ("language", "proprio")


class M2Distill(Rehearsal):
    """Keep the features of each modality, and the distribution of actions, near those of the policy before the task.

    M2Distill (Roy et al. 2024, "M2Distill: Multi-modal distillation for lifelong imitation learning",
    arXiv:2410.00064). With f_m the features of modality m and p the distribution of actions, primed ones those of the
    frozen policy at the end of the last task, the loss is

        L(B u M) + image sum_v |f_v - f'_v|^2 + language |f_l - f'_l|^2 + proprio |f_p - f'_p|^2 + policy D(p' || p)

    over cameras v. Squares are summed over the numbers of a token and averaged over tokens, frames and windows. The
    four terms are computed on windows of earlier tasks, drawn anew and augmented as training batches are, beside those
    that join the batch as in experience replay.

    Departures: the paper estimates the Kullback-Leibler divergence of mixtures by samples; D is the head's closed
    `divergence`, an upper bound of it for mixtures and the squared distance of the means for other heads. Where
    patches of all cameras are mixed, their common token is one image. The joints and the gripper have one weight. The
    text at hand stated neither the paper's weights nor on which windows it distils: these are this package's choices.
    """

    state_form = {"memory": MEMORY_FORM, "teacher": Weights()}
    tuned = {"policy": (0.03, 0.1, 0.3, 1.0), "image": (0.001, 0.003, 0.01, 0.1)}

    def __init__(
        self,
        *,
        budget: Count = 10_000,
        ratio: Positive = 1.0,
        image: NonNegative = 0.003,
        language: NonNegative = 0.003,
        proprio: NonNegative = 0.003,
        policy: NonNegative = 0.1,
    ):
        """Create the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks.
            ratio: Number of windows replayed for each window of the present task, and as many others to distil on.
            image: Weight of the cameras' features.
            language: Weight of the instruction's features.
            proprio: Weight of the readings' features.
            policy: Weight of the divergence of actions. With a deterministic head stronger distillation (1, and 0.1 or
                0.01 for the features) kept and learned less than replay alone (experiments/tuning): it also keeps the
                teacher's errors. The divergence of mixtures has the unit of their loss, so that 1 weighs both alike;
                this was not measured.
        """
        super().__init__(ReplayMemory(budget), ratio)
        self.image, self.language, self.proprio, self.policy = image, language, proprio, policy
        self.teacher = Teacher()
        self.distilled: Batch | None = None  # drawn by `mix`, used by `penalty`

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by `ratio` times as many earlier windows; others are drawn to distil on."""
        if not len(self.memory):
            return batch
        drawn = self._drawn(batch, generator)
        self.distilled = drawn if self.augment is None else self.augment(drawn, generator)
        return batch.join(self._drawn(batch, generator))

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Check, before anything is learned, that the policy has features to distil."""
        super().begin_task(task_index, dataset, with_features(policy))

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return the weighted sum of `distances` on the drawn windows, a scalar; None during the first task."""
        if self.distilled is None:
            return None
        student = with_features(policy)
        observation = self.distilled.to(device_of(student)).observation
        self.distilled = None
        parts = distances(student, self.teacher.like(student), observation)
        return torch.stack([getattr(self, name) * distance for name, distance in parts.items()]).sum()

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Make the present weights the teacher's, and add the task's windows to the memory."""
        super().end_task(task_index, dataset, policy, generator)
        self.teacher.become(copy_weights(policy))


def distances(student: HistoryPolicy, teacher: HistoryPolicy, observation: Observation) -> dict[str, Tensor]:
    """Return how far a policy is from a teacher on windows, by kind, each a scalar with gradients to the student.

    Args:
        student: Policy that learns.
        teacher: Policy of the same form.
        observation: What both see.

    Returns:
        `language`, `proprio` (where there is any) and `image`, squared distances of features, and `policy`, the
        divergence of actions.
    """
    with torch.no_grad():
        before = teacher.encode(observation)
        answers = teacher.head.answers(teacher.head(teacher.over_time(before)))
    features = student.encode(observation)
    params = student.head(student.over_time(features))
    parts = {"policy": student.head.divergence(answers, params).mean()}
    old, new = teacher.modalities(before), student.modalities(features)
    for name, part in new.items():
        kind = name if name in _NOT_IMAGES else "image"
        distance = (part.float() - old[name].float()).square().sum(-1).mean()
        parts[kind] = parts[kind] + distance if kind in parts else distance
    return parts
