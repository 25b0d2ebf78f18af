"""The original's lifelong-learning algorithms: those of `lifelong.algorithms` with its methods."""

import copy
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset

from libero._adapters.batches import DictWindows
from libero._adapters.batches import join_tensors as merge_datas
from libero._adapters.lookup import alias_modules
from libero.lifelong.algos.base import REGISTERED_ALGOS, Sequential, get_algo_class, get_algo_list
from libero.lifelong.metric import evaluate_success
from lifelong import algorithms
from lifelong.algorithms.importance import BatchFisher
from lifelong.data.memory import ReplayMemory


def cycle(dl: Iterable[Any]) -> Iterator[Any]:
    """Yield the items of a loader, again and again."""
    while True:
        yield from dl


class _MemoryOfTasks(ReplayMemory):
    """As many windows of each task, drawn uniformly, and no more of one where another has fewer."""

    def _order(self, dataset: Any, generator: torch.Generator) -> Tensor:
        return super()._order(dataset, generator)[: self.budget]

    def _shares(self, sizes: Mapping[int, int]) -> dict[int, int]:
        return dict(sizes)


class ER(Sequential):
    """Joins to every batch as many windows of earlier tasks; see `lifelong.algorithms.ER`.

    `lifelong.n_memories` windows of each task are kept, drawn uniformly (the original keeps the first of each file).
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.ER(memory=_MemoryOfTasks(cfg.lifelong.n_memories))


class AGEM(ER):
    """Projects out of the gradient what would raise the loss on ER's memory; see `lifelong.algorithms.AGEM`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.AGEM(memory=_MemoryOfTasks(cfg.lifelong.n_memories))


class EWC(Sequential):
    """Pulls weights towards their values after earlier tasks; see `lifelong.algorithms.EWC`.

    The Fisher information is the original's estimate from batches of all windows, which `lifelong.e_lambda` is for.
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.EWC(
            strength=float(cfg.lifelong.e_lambda),
            gamma=cfg.lifelong.gamma,
            estimator=BatchFisher(windows=0, batch_size=cfg.train.batch_size),
        )

    def penalty(self) -> Tensor:
        """Return the penalty on the present weights, without the factor `lifelong.e_lambda`."""
        hooks = copy.copy(self.hooks)
        hooks.strength = 1.0
        penalty = hooks.penalty(self.policy)
        return torch.zeros(()) if penalty is None else penalty


class PackNet(Sequential):
    """Trains, prunes, and retrains the weights that the task keeps; see `lifelong.algorithms.PackNet`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.PackNet(prune_perc=cfg.lifelong.prune_perc)

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Prune, and retrain for `post_prune_epochs`; the weights of the best of these epochs are kept."""
        settings, (train, retrain) = self.cfg.lifelong, self.hooks.phases()
        self.hooks.end_phase(train, self.policy)
        self.hooks.begin_phase(retrain, self.policy)
        if epochs := settings.post_prune_epochs:
            self.make_optimizer(epochs)
            path, measure = self.checkpoint_path(task_id), self._measure(task_id, benchmark)
            self.train_policy(dataset, epochs, settings.post_eval_every, path, measure, phase=1)
        self.hooks.end_phase(retrain, self.policy)
        self.hooks.end_task(task_id, DictWindows(dataset, task_id), self.policy, self.draws)

    @property
    def previous_masks(self) -> dict[str, Tensor]:
        """Owner of each weight: 0 where it is free, k + 1 for task k."""
        return dict(self.hooks.state_dict()["owner"])

    def load_masks(self, masks: Mapping[str, Tensor], task_id: int) -> None:
        """Load the masks of a checkpoint that was written after a task."""
        self.hooks.load_state_dict({"task_index": task_id, "pruned": True, "owner": masks}, {})

    def get_eval_algo(self, task_id: int) -> "PackNet":
        """Return a copy whose policy has only the weights of the tasks, or groups, up to that of this task."""
        other = copy.copy(self)
        other._modules = dict(self._modules)
        with self.acting_on(task_id):
            other.policy = copy.deepcopy(self.policy)
        other.hooks = algorithms.Sequential()
        other.eval()
        return other


class SingleTask(Sequential):
    """Trains every task from the initial weights and acts with its own; see `lifelong.algorithms.SingleTask`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.SingleTask()


class Multitask(Sequential):
    """Trains on the windows of all tasks, shuffled together."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        return algorithms.Multitask()

    def learn_all_tasks(
        self, datasets: Sequence[Dataset], benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Train on all tasks; write `multitask_model.pth`, and `multitask_model_ep<n>.pth` at each evaluation.

        With `lifelong.eval_in_train`, and without `pretrain`, the success on all tasks is measured at each evaluation
        and the best weights are kept, else the last.

        Returns:
            Success (0 if it is not measured) and loss, as `learn_one_task` returns them.
        """
        self.start_task(-1)
        tasks, measured = (
            list(range(benchmark.n_tasks)),
            self.cfg.lifelong.eval_in_train and not self.cfg.pretrain,
        )

        def measure(epoch: int) -> float | None:
            self.save(os.path.join(self.experiment_dir, f"multitask_model_ep{epoch}.pth"))
            return float(np.mean(evaluate_success(self.cfg, self, benchmark, tasks))) if measured else None

        windows, path = ConcatDataset(datasets), os.path.join(self.experiment_dir, "multitask_model.pth")
        rates = self.train_policy(windows, self.cfg.train.n_epochs, self.cfg.eval.eval_every, path, measure)
        self.end_task(windows, 0, benchmark)
        return rates


alias_modules(__name__, "agem er ewc multitask packnet single_task")
