"""What methods share that freeze a base and learn low-rank experts on it: how experts begin, act, and are stored."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm, Phase
from lifelong.errors import PolicyError
from lifelong.nn.experts import Attachment, ExpertLibrary, expert_output, freeze_statistics
from lifelong.policies.base import Policy
from lifelong.types import to_device


class FrozenBase(Algorithm):
    """The first tasks train the whole policy, which is frozen then; each later one has low-rank experts on it."""

    state_form: ClassVar[Any] = {
        **dict.fromkeys(("task_index", "base_left", "seed"), int),
        "library": ExpertLibrary.form,
    }

    def __init__(self, *, rank: int, alpha: float, adapted: Sequence[str], base_tasks: int):
        """Create the algorithm; see the subclasses for the arguments."""
        self.rank, self.scale, self.adapted = rank, alpha / rank, tuple(adapted)
        self.task_index, self.base_left = -1, base_tasks
        # of the draws at the next task's beginning; drawn when a task ends, before the first one when it begins
        self.seed = -1
        self.library = ExpertLibrary()

    def _begin(self, task_index: int, policy: Policy) -> torch.Generator | None:
        """Go on to a task and return the generator of its experts' draws; None where it trains the whole policy."""
        self.task_index = task_index
        if self.base_left:
            self.base_left -= 1
            return None
        if self.seed < 0:
            self.seed = int(torch.randint(2**62, ()))
        policy.zero_grad()  # the optimiser, which does it at each step, no longer has the base
        return torch.Generator().manual_seed(self.seed)

    def _draw_seed(self, generator: torch.Generator) -> None:
        """Draw the seed of the next task's experts."""
        self.seed = int(torch.randint(2**62, (), generator=generator))

    def named_parameters(self, policy: Policy) -> Iterable[tuple[str, nn.Parameter]]:
        """Return the policy's parameters, and each expert's with the name of its layer or weight."""
        pairs = [item for of_task in self.library.values() for item in of_task.items()]
        return [*policy.named_parameters(), *((name, p) for name, pair in pairs for p in pair.values())]

    def mode_train(self, policy: Policy) -> None:
        """Set training mode, with running statistics frozen with the base."""
        policy.train()
        if self.library:
            freeze_statistics(policy)


class RoutedExperts(FrozenBase):
    """Experts beside layers of the policy, chosen by what is observed, so that acting needs no task number.

    Hooks of the layers add the experts' outputs, see `_hooks`. They are attached while experts are learned and while
    the policy acts.
    """

    relu: ClassVar[bool] = False  # whether a ReLU lies between the A and the B of an expert

    def __init__(self, **settings: Any):
        """Create the algorithm; see `FrozenBase`."""
        super().__init__(**settings)
        self._attachment = Attachment()
        self._learning: int | None = None  # task whose experts all samples use; None: each has its own
        self._now: Any = None  # what `encode` chose for the rows of the present forward pass

    def _begin(self, task_index: int, policy: Policy) -> torch.Generator | None:
        """Begin a task; see `FrozenBase`.

        Raises:
            PolicyError: What the policy's layers are given is not in the order of the windows.
        """
        if not getattr(policy, "by_window", True):
            raise PolicyError(
                f"{type(self).__name__} gives each window its adapters, and the layers of {type(policy).__name__} "
                "are not given one window beside the other; use algo=lora"
            )
        return super()._begin(task_index, policy)

    def _hooks(self, policy: Policy) -> tuple[Any, ...]:
        """Return arguments of `Attachment.attach`: layers, what is added to their outputs, and maybe an `encode`."""
        raise NotImplementedError

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the parameters of the task's experts; everything while the base is learned."""
        if self.task_index not in self.library:
            return super().trained(policy)
        policy.requires_grad_(False)
        self._learning = self.task_index
        self._attachment.attach(policy, *self._hooks(policy))
        return self.library.parameters(self.task_index)

    def end_phase(self, phase: Phase, policy: Policy) -> None:
        """Remove the experts from the policy's layers."""
        self._attachment.detach(policy)
        self._learning = self._now = None

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy that chooses experts, the same for every task."""
        if not self.library:
            yield policy
            return
        with self._using(self._acting(), policy, *self._hooks(policy)):
            yield policy

    def _acting(self) -> int | None:
        """Return the task whose experts act on all samples; None: each sample chooses."""
        return None

    @contextmanager
    def _using(self, task: int | None, policy: Policy, *hooks: Any) -> Iterator[None]:
        """Attach experts within the context, those of a task or, without it, those that each sample chooses."""
        learning, self._learning = self._learning, task
        try:
            with self._attachment.within(policy, *hooks):
                yield
        finally:
            self._learning, self._now = learning, None

    def _grouped_output(
        self, name: str, layer: nn.Module, x: Tensor, groups: Iterable[tuple[int, Tensor | None]]
    ) -> Tensor | None:
        """Return what experts add to a layer's output, each on its rows; None where all rows use the base alone.

        Args:
            x: Its input.
            groups: Tasks, each with the rows (n,) its experts act on, None for all; one without experts adds nothing.
        """
        total: Tensor | None = None
        for task, rows in groups:
            if task not in self.library:
                continue
            rows = None if rows is None else to_device(rows, x.device)
            pairs, own = [self.library[task][name]], x if rows is None else x[rows]
            part = self.scale * expert_output(layer, own, pairs, relu=self.relu)
            if rows is None:
                return part
            if total is None:
                total = part.new_zeros(len(x), *part.shape[1:])
            total[rows] = part
        return total
