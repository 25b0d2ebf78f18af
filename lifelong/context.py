"""The context of a run: everything it consists of, as one value."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from libero_env.parallel import cpu_count
from libero_env.perturbations import Perturbation, reword_task
from libero_env.tasks import Task
from lifelong.algorithms.base import Algorithm
from lifelong.data.settings import DataSettings
from lifelong.evaluation.environments import EnvPool, HeldOutShift
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from lifelong.results.run_directory import RunDirectory
from lifelong.streams import StreamSettings
from lifelong.tracking import Tracker
from lifelong.training.distributed import Ranks
from lifelong.training.settings import FitSettings
from lifelong.training.step import BatchAugmentation


@runtime_checkable
class Learner(Protocol):
    """How a stage is learned other than from its demonstrations."""

    def check(self, context: "RunContext") -> None:
        """Raise a ConfigError if a run cannot learn so."""

    def training(
        self,
        context: "RunContext",
        stage: Sequence[int],
        seed: Sequence[int],
        resume: Mapping[str, Any] | None,
        offset: int = 0,
    ) -> AbstractContextManager[dict[str, Any]]:
        """Yield arguments of `lifelong.training.fit.fit` for a phase of training.

        Args:
            stage: Positions of the tasks.
            seed: Integers that identify the phase within the run.
            resume: State of `fit` that it goes on from; None from the start.
            offset: Number of epochs of the stage's earlier phases.
        """


@dataclass(frozen=True)
class RunContext:
    """Everything a run consists of, built once from its configuration.

    Attributes:
        tasks: The K tasks in learning order.
        languages: (K + H, L) embeddings of `instructions`, then of the held-out tasks'.
        demos: Number of demonstrations of each task.
        policy: Policy, trained in place.
        algorithm: Lifelong algorithm.
        fit: Settings of training.
        eval: Settings of evaluation.
        augment: Augmentation of training batches.
        stream: Settings of the order in which data arrive.
        group_sizes: Number of tasks in each group that is one step of the sequence.
        envs: Environments by (position of the task, number of simulations).
        directory: Directory of checkpoints and records.
        tracker: Copies the metrics to another program.
        seed: Seed from which all randomness of the run is derived.
        progress: Whether to show progress bars; None prints lines where demonstrations are recorded
            and policies are evaluated.
        ranks: Rank of this process among those that train together.
        perturb: Perturbations of each task, under which it is learned and evaluated; () for none at all.
        shift: Held-out shift under which policies are evaluated besides; None for none.
        learner: How stages are learned; None for behaviour cloning.
        held_out: The H tasks that are evaluated and never learned; their positions follow those of the others.
    """

    tasks: tuple[Task, ...]
    languages: Tensor
    demos: tuple[int, ...]
    data: DataSettings
    policy: Policy
    algorithm: Algorithm
    fit: FitSettings
    eval: EvalSettings
    augment: BatchAugmentation | None
    stream: StreamSettings
    group_sizes: tuple[int, ...]
    envs: EnvPool
    directory: RunDirectory
    tracker: Tracker
    seed: int
    device: torch.device
    progress: bool | None
    ranks: Ranks = Ranks()
    perturb: tuple[tuple[Perturbation, ...], ...] = ()
    shift: HeldOutShift | None = None
    learner: Learner | None = None
    held_out: tuple[Task, ...] = ()

    @property
    def works_beside(self) -> bool:
        """Whether rollouts and recordings run in processes of their own while this one learns, see `eval.beside`."""
        alone = self.ranks.size == 1 and self.device.type == "cpu" and not self.eval.back_end.is_warp
        return self.eval.beside and alone and cpu_count() > 1

    @property
    def never_learned(self) -> range:
        """Positions of the held-out tasks."""
        return range(len(self.tasks), len(self.tasks) + len(self.held_out))

    @property
    def untrained(self) -> tuple[int, ...]:
        """Positions of the tasks that are evaluated before the first is learned."""
        return (*(range(len(self.tasks)) if self.eval.unseen != "none" else ()), *self.never_learned)

    @property
    def perturbed(self) -> tuple[tuple[Perturbation, ...], ...]:
        """Perturbations of each task, which may be none."""
        return self.perturb or ((),) * len(self.tasks)

    @property
    def instructions(self) -> tuple[str, ...]:
        """Instruction of each task, in the words that its perturbations give it."""
        pairs = zip(self.tasks, self.perturbed, strict=True)
        return tuple(reword_task(task, found).language for task, found in pairs)
