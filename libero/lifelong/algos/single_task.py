"""One policy for each task."""

from typing import Any

from libero.lifelong.algos.base import Sequential
from lifelong import algorithms


class SingleTask(Sequential):
    """Trains every task from the initial weights and acts with its own; see `lifelong.algorithms.SingleTask`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.SingleTask()
