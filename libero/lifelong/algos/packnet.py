"""PackNet: every task owns a share of the weights."""

import copy
from collections.abc import Mapping
from typing import Any, cast

from torch import Tensor
from torch.utils.data import Dataset

from libero._adapters.lifelong.batches import DictWindows
from libero.lifelong.algos.base import Sequential, members
from libero.lifelong.utils import torch_save_model
from lifelong import algorithms


class PackNet(Sequential):
    """Train, prune, retrain what the task keeps; see `lifelong.algorithms.PackNet`."""

    hooks: algorithms.PackNet

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.PackNet(prune_perc=cfg.lifelong.prune_perc)

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Prune, and train for `post_prune_epochs` what the task keeps; the best of its epochs is taken."""
        settings, (train, retrain) = self.cfg.lifelong, self.hooks.phases()
        self.hooks.end_phase(train, cast(Any, self.policy))
        self.hooks.begin_phase(retrain, cast(Any, self.policy))
        if settings.post_prune_epochs:
            self.prepare(settings.post_prune_epochs)
            tasks = members(self.cfg, task_id)
            self.practise(
                dataset,
                settings.post_prune_epochs,
                settings.post_eval_every,
                self.checkpoint(task_id),
                lambda _: self.success_on(tasks, benchmark) if self.cfg.eval.eval else None,
            )
        self.hooks.end_phase(retrain, cast(Any, self.policy))
        windows = cast(Any, DictWindows(dataset, task_id))
        self.hooks.end_task(task_id, windows, cast(Any, self.policy), self.draws)

    @property
    def previous_masks(self) -> dict[str, Tensor]:
        """Of each weight: 0 where it is free, k + 1 where task k owns it."""
        return dict(self.hooks.state_dict()["owner"])

    def take_masks(self, masks: Mapping[str, Tensor], task_id: int) -> None:
        """Go on from the masks that a checkpoint made after a task holds."""
        self.hooks.load_state_dict({"task_index": task_id, "pruned": True, "owner": masks}, {})

    def get_eval_algo(self, task_id: int) -> "PackNet":
        """A copy whose policy has only the weights of the tasks up to this one."""
        other = copy.copy(self)
        other._modules = dict(self._modules)
        with self.acting_on(task_id):
            other.policy = copy.deepcopy(self.policy)
        other.hooks = cast(Any, algorithms.Sequential())
        other.eval()
        return other

    def save(self, path: str) -> None:
        """See `Sequential`; with the masks."""
        torch_save_model(self.policy, path, cfg=self.cfg, previous_masks=self.previous_masks)
