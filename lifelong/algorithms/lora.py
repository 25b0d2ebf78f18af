"""Low-rank adapters for each task on a frozen base."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import acting_with, put_weights
from lifelong.algorithms.frozen_base import FrozenBase
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.nn.experts import Pair, matches, matching
from lifelong.policies.base import Policy
from lifelong.types import Natural, NonNegative, Width

OWN = ("*bias*", "*norm*")  # patterns of which some policies have none


class LoRA(FrozenBase):
    """Learn the first task with the whole policy, and every later one with a small adapter on it.

    TAIL (Liu et al. 2024, "TAIL: Task-specific adapters for imitation learning with large pretrained models", ICLR)
    with LoRA (Hu et al. 2022): the weight of task k is `W_k = W + (alpha / rank) B_k A_k` (Hu et al., eq. 3) with W
    frozen. Every task has its own copy of small parameters (`own`). Nothing that an earlier task uses changes: its
    outputs stay bit-identical.

    The sum is stored in the policy's own parameters, so layers of any kind compute as usual: linear, convolution,
    recurrent. Gradients come from the chain rule, dL/dB = s G A^T and dL/dA = s B^T G with G = dL/dW_k; the optimiser
    moves A and B, and W_k is computed again after each step.

    `adapters` may be other than TAIL's:

    * `shared`: one adapter learns through the whole stream after the base, with one set of own copies; one policy
      acts on all tasks, as in the continual fine-tuning of large policies (Hu et al. 2026, arXiv:2603.11653).
    * `averaged`: every task learns an adapter on the base, and one policy acts on all tasks, with the mean of what
      they change. Where the base learned tasks of its own, it counts as one that changes nothing. This is the uniform
      model soup of Wortsman et al. 2022, arXiv:2203.05482. While a task is learned, its own adapter acts.

    Departures: TAIL adapts large pretrained encoders and a transformer; here the base is the policy after the first
    `base_tasks`, or as it was pretrained with `base_tasks=0`, and by default every matrix is adapted,
    because a base that has learned one task has no general features. There is no dropout before A.
    """

    acts_by_weights = True
    state_form = {
        **FrozenBase.state_form,
        "base_last": int,
        "base": Weights(),
        "kept": {int: Weights()},
    }

    def __init__(
        self,
        *,
        rank: Width = 16,
        alpha: NonNegative = 32.0,
        adapted: Sequence[str] = ("*",),
        own: Sequence[str] = OWN,
        base_tasks: Natural = 1,
        adapters: Literal["own", "shared", "averaged"] = "own",
    ):
        """Create the algorithm.

        Args:
            rank: Rank of the adapters, at most the smaller side of a weight.
            alpha: Numerator of the adapters' scale alpha / rank.
            adapted: Patterns of names of the parameters that get adapters, of those with two or more dimensions,
                e.g. `transformer.*`, `head.*`, `*.qkv.weight`.
            own: Patterns of names of parameters of which every task has its own copy.
            base_tasks: Number of tasks (stages, where tasks are learned together) that train the whole policy,
                which is frozen afterwards; 0 for a pretrained policy.
            adapters: Whether a task acts with its own adapter, all with the one that they share, or with their average.
        """
        super().__init__(rank=rank, alpha=alpha, adapted=adapted, base_tasks=base_tasks)
        self.own, self.base_last, self.adapters = tuple(own), -1, adapters
        self.base: dict[str, Tensor] = {}  # frozen values of all that a task may change
        self.kept: dict[int, dict[str, Tensor]] = {}  # learned task -> its own copies

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Freeze the base once it is learned, and initialise the task's adapter."""
        names = self._choose(policy) if not self.base else []
        draws = self._begin(task_index, policy)
        if draws is None:
            self.base_last = task_index
            return
        if not self.base:
            self.base = {n: p.detach().clone() for n, p in policy.named_parameters() if n in names}
        elif self.adapters == "shared":
            return
        adapted = {name: base for name, base in self.base.items() if not matches(name, self.own)}
        self.library.add(task_index, adapted, self.rank, draws)
        put_weights(policy, self.base)

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the task's A and B and its own copies; everything while the base is learned."""
        pairs = self._present()
        if not pairs:
            return super().trained(policy)
        chosen: list[Any] = []
        for name, p in policy.named_parameters():
            p.requires_grad_(name in self.base)
            if name in pairs:
                chosen += pairs[name].values()
            elif name in self.base:
                chosen.append(p)
        return chosen

    @torch.no_grad()
    def after_backward(self, policy: Policy) -> None:
        """Compute the gradients of A and B from those of the weights, which are then dropped."""
        pairs = self._present()
        for name, p in policy.named_parameters():
            if name in pairs and p.grad is not None:
                a, b, g = pairs[name]["a"], pairs[name]["b"], p.grad.flatten(1)
                with torch.autocast(p.device.type, enabled=False):
                    a.grad, b.grad = self.scale * (b.T @ g), self.scale * (g @ a.T)
                p.grad = None

    def after_step(self, policy: Policy) -> None:
        """Compute the adapted weights again."""
        pairs = self._present()
        put_weights(policy, {name: self._sum(name, pair) for name, pair in pairs.items()})

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store the task's own copies; its A and B are stored already."""
        self._draw_seed(generator)
        if task_index in self.library and self.adapters != "shared":
            params = dict(policy.named_parameters())
            names = self.base.keys() - self.library[task_index].keys()
            self.kept[task_index] = {n: params[n].detach().clone() for n in sorted(names)}

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with the task's adapter; unchanged for the present task and those not begun."""
        with acting_with(policy, self._acting(task_index)):
            yield policy

    def _acting(self, task_index: int) -> dict[str, Tensor]:
        """Return the weights that act on a task, where they are not the policy's own."""
        learns = self.task_index in self.library and self.task_index not in self.kept
        if not self.base or self.adapters == "shared" or (learns and self.adapters == "averaged"):
            return {}
        if self.adapters == "averaged":
            found = [self._weights(task) for task in ([-1] if self.base_last >= 0 else []) + list(self.kept)]
            return {name: torch.stack([one[name] for one in found]).mean(0) for name in self.base}
        learned = [-1] if task_index <= self.base_last else [t for t in self.kept if t >= task_index]
        return self._weights(min(learned)) if learned else {}  # index of the last task of a stage

    def _weights(self, stage: int) -> dict[str, Tensor]:
        """Return the weights with a stage's adapter and own copies; those of the base where it has none."""
        sums = {name: self._sum(name, pair) for name, pair in self.library.get(stage, {}).items()}
        return self.base | sums | self.kept.get(stage, {})

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: An adapter does not fit its weight.
        """
        super().load_state_dict(state, datasets)
        for of_task in state["library"].values():
            check_pairs(of_task, self.base)

    def _present(self) -> Mapping[str, Mapping[str, nn.Parameter]]:
        """Return the present task's pairs, or those that all tasks share; none while the base is learned."""
        if self.adapters == "shared":
            return next(iter(self.library.values()), {})
        return self.library.get(self.task_index, {})

    def _choose(self, policy: Policy) -> list[str]:
        """Return the names of all parameters that tasks may change."""
        learned = {n: p for n, p in policy.named_parameters() if p.requires_grad}
        matrices = [n for n, p in learned.items() if p.dim() >= 2 and not matches(n, self.own)]
        adapted = matching(matrices, self.adapted, "matrix")
        if self.own and self.own != OWN:
            matching(list(learned), self.own, "parameter", "algo.own")
        return [n for n in learned if n in adapted or matches(n, self.own)]

    @torch.no_grad()
    def _sum(self, name: str, pair: Pair) -> Tensor:
        """Return W + (alpha / rank) B A."""
        base = self.base[name]
        return base + (self.scale * (pair["b"] @ pair["a"])).view(base.shape)


def check_pairs(pairs: Mapping[str, Mapping[str, Tensor]], base: Mapping[str, Tensor]) -> None:
    """Check that the A and B of an adapter fit the weights of the base.

    Raises:
        CheckpointError: One does not; the message names it.
    """
    for name, pair in pairs.items():
        a, b, weight = pair["a"], pair["b"], base.get(name)
        fits = a.dim() == b.dim() == 2 and len(a) == b.shape[1]
        if weight is None or not fits or (len(b), a.shape[1]) != weight.flatten(1).shape:
            raise CheckpointError(f"the adapter of {name} does not fit a weight of the base")
