"""Low-rank adapters that begin at a prior which is learned online over the tasks."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.base import put_weights
from lifelong.algorithms.lora import OWN, LoRA, check_pairs
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.policies.base import Policy
from lifelong.types import Natural, NonNegative, Share, Width

Prior = dict[str, dict[str, Any]]  # pairs: name -> a, b; own: name -> value


class OMLA(LoRA):
    """Learn every task with an adapter, as LoRA does, that begins where adapters of earlier tasks suggest.

    Online meta-learned adapters (Zhu et al. 2025, arXiv:2503.18684; as OMA in IEEE RA-L 2026): an initialisation of
    the adapter, the prior, is meta-learned from task to task on a frozen pretrained policy, and each new task is
    fine-tuned from it. Adapters of earlier tasks are never touched, so nothing is forgotten.

    The prior phi holds A, B and the own copies of a task. The first adapter begins as LoRA's; it is phi_0. After each
    task, with the adapter psi_t that learning from phi_{t-1} ended with,

        phi_t = phi_{t-1} + prior_rate (psi_t - phi_{t-1}),

    the online form of Reptile (Nichol et al. 2018, arXiv:1803.02999, algorithm 1), whose expected update is to leading
    orders that of first-order MAML: it moves to where few steps suffice on each task, not only to where the mean loss
    is low. All adapters begin at a common A, so sums of their factors have a meaning. With `prior_rate=0` there is no
    prior, and every bit is LoRA's; with 1 each task begins with the last one's adapter.

    Departures: the paper has a meta-objective over data of earlier tasks, of which some are kept and chosen by
    anchors, and optimises the prior in a stage of its own before each task. Here its learned adapters stand for the
    earlier tasks: no data are kept, and no steps are spent on the prior. Its constants were not at hand: `prior_rate`
    is ours.
    """

    state_form = {
        **LoRA.state_form,
        "prior": (None, {"pairs": {str: {"a": Tensor, "b": Tensor}}, "own": Weights()}),
    }

    def __init__(
        self,
        *,
        prior_rate: Share = 0.5,
        rank: Width = 16,
        alpha: NonNegative = 32.0,
        adapted: Sequence[str] = ("*",),
        own: Sequence[str] = OWN,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            prior_rate: Share of the way that the prior moves to each learned adapter, in [0, 1]; 0 for LoRA.
            rank: Rank of the adapters, at most the smaller side of a weight.
            alpha: Numerator of the adapters' scale alpha / rank.
            adapted: Patterns of names of the parameters that get adapters.
            own: Patterns of names of parameters of which every task has its own copy.
            base_tasks: Number of tasks (stages) that train the whole policy; 0 for a pretrained policy.
        """
        super().__init__(rank=rank, alpha=alpha, adapted=adapted, own=own, base_tasks=base_tasks)
        self.prior_rate = prior_rate
        self.prior: Prior | None = None  # None before the first adapter, and without a prior

    @torch.no_grad()
    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Begin as LoRA does, and put the task's adapter where the prior is; the first adapter's start is the prior."""
        super().begin_task(task_index, dataset, policy)
        pairs = self.library.get(task_index)
        if pairs is None or not self.prior_rate:
            return
        if self.prior is None:
            start = {name: {k: t.detach().clone() for k, t in pair.items()} for name, pair in pairs.items()}
            own = {name: value.clone() for name, value in self.base.items() if name not in pairs}
            self.prior = {"pairs": start, "own": own}
            return
        for name, pair in pairs.items():
            for factor, value in pair.items():
                value.copy_(self.prior["pairs"][name][factor])
        put_weights(policy, self.prior["own"])
        self.after_step(policy)  # the adapted weights

    @torch.no_grad()
    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store the task's own copies, and move the prior towards its adapter."""
        super().end_task(task_index, dataset, policy, generator)
        if self.prior is None:
            return
        learned, kept = self.library[task_index], self.kept[task_index]
        self.prior = {
            "pairs": {
                name: {k: torch.lerp(t, learned[name][k].detach(), self.prior_rate) for k, t in pair.items()}
                for name, pair in self.prior["pairs"].items()
            },
            "own": {n: torch.lerp(t, kept[n], self.prior_rate) for n, t in self.prior["own"].items()},
        }

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: An adapter or the prior does not fit its weight.
        """
        super().load_state_dict(state, datasets)
        if self.prior is not None:
            check_pairs(self.prior["pairs"], self.base)
            if self.prior["pairs"].keys() ^ self.prior["own"].keys() != self.base.keys():
                raise CheckpointError("the prior is not that of the weights which the tasks change")
