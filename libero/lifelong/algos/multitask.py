"""Training on all tasks together."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch.utils.data import ConcatDataset, Dataset

from libero.lifelong.algos.base import Sequential
from libero.lifelong.metric import evaluate_multitask_training_success
from lifelong import algorithms


class Multitask(Sequential):
    """Trains on the windows of all tasks, shuffled together."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.Multitask()

    def learn_all_tasks(
        self, datasets: Sequence[Dataset], benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Train on all tasks; write `multitask_model.pth`, and `multitask_model_ep<n>.pth` at each evaluation.

        With `lifelong.eval_in_train` the success on all tasks is measured at each evaluation and the best weights are
        kept, else the last.

        Returns:
            Success (0 if it is not measured) and loss, as `learn_one_task` returns them.
        """
        self.start_task(-1)
        tasks, every = list(range(benchmark.n_tasks)), self.cfg.eval.eval_every

        def measure(number: int) -> float | None:
            self.save(os.path.join(self.experiment_dir, f"multitask_model_ep{number * every}.pth"))
            if not self.cfg.lifelong.eval_in_train:
                return None
            return float(np.mean(evaluate_multitask_training_success(self.cfg, self, benchmark, tasks)))

        windows, path = ConcatDataset(datasets), os.path.join(self.experiment_dir, "multitask_model.pth")
        curve = self.train_policy(windows, self.cfg.train.n_epochs, every, path, measure)
        self.end_task(windows, 0, benchmark)
        return curve.means()
