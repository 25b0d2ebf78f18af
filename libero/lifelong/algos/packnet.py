"""PackNet: every task owns a share of the weights."""

import copy
from collections.abc import Mapping
from typing import Any

from torch import Tensor
from torch.utils.data import Dataset

from libero._adapters.lifelong.batches import DictWindows
from libero.lifelong.algos.base import Sequential
from lifelong import algorithms


class PackNet(Sequential):
    """Trains, prunes, and retrains the weights that the task keeps; see `lifelong.algorithms.PackNet`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.PackNet(prune_perc=cfg.lifelong.prune_perc)

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Prune, and retrain for `post_prune_epochs`; the weights of the best of these epochs are kept."""
        settings, (train, retrain) = self.cfg.lifelong, self.hooks.phases()
        self.hooks.end_phase(train, self.policy)
        self.hooks.begin_phase(retrain, self.policy)
        if epochs := settings.post_prune_epochs:
            self.make_optimizer(epochs)
            path, measure = self.checkpoint(task_id), lambda _: self.measure_success(task_id, benchmark)
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
        """Return a copy whose policy has only the weights of the tasks up to this one."""
        other = copy.copy(self)
        other._modules = dict(self._modules)
        with self.acting_on(task_id):
            other.policy = copy.deepcopy(self.policy)
        other.hooks = algorithms.Sequential()
        other.eval()
        return other
