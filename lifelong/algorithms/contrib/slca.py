"""Fine-tuning in which the representation moves more slowly than the rest."""

from collections.abc import Mapping, Sequence

from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import TaskWindows
from lifelong.nn.experts import matching
from lifelong.policies.base import Policy
from lifelong.types import Natural, Share


class SLCA(Algorithm):
    """Fine-tune on each task, with a smaller learning rate for the representation.

    The slow learner of SLCA (Zhang et al. 2023, "SLCA: slow learner with classifier alignment for continual learning on
    a pre-trained model", ICCV, section 3.2): the backbone has the rate `factor * train.lr`, the rest `train.lr`.

    Departures: the alignment of classifiers, which draws features of earlier classes from a Gaussian for each, has no
    counterpart in the cloning of continuous actions, and is left out. A policy that is not pretrained must learn its
    representation with the first `base_tasks`, at the full rate.
    """

    state_form = {"base_left": int}

    def __init__(
        self, *, slow: Sequence[str] = ("encoders*",), factor: Share = 0.01, base_tasks: Natural = 1
    ):
        """Create the algorithm.

        Args:
            slow: Patterns of names of the parameters that move slowly.
            factor: Factor on their learning rate; 0.01 in the paper.
            base_tasks: Number of tasks (stages) that train everything at the full rate; 0 for a pretrained policy.
        """
        self.slow, self.factor = tuple(slow), factor
        self.base_left = base_tasks + 1  # of the present task on, which is counted when it begins

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Count the tasks that are learned at the full rate; check that something is slow."""
        self._slow(policy)
        self.base_left = max(0, self.base_left - 1)

    def rate_factors(self, policy: Policy) -> Mapping[str, float]:
        """Return the factors of the policy, those of slow parameters multiplied by `factor` after the base tasks."""
        factors = dict(super().rate_factors(policy))
        for name in self._slow(policy) if not self.base_left else ():
            own = [factor for beginning, factor in factors.items() if name.startswith(beginning)]
            factors[name] = self.factor * (own[-1] if own else 1.0)
        return factors

    def _slow(self, policy: Policy) -> list[str]:
        return matching([name for name, _ in policy.named_parameters()], self.slow, "parameter", "algo.slow")
