"""Averaged gradient episodic memory."""

from typing import Any

from libero.lifelong.algos.er import ER
from lifelong import algorithms
from lifelong.data.memory import ReplayMemory


class AGEM(ER):
    """Projects out of the gradient what would raise the loss on ER's memory; see `lifelong.algorithms.AGEM`."""

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.AGEM(memory=ReplayMemory(cfg.lifelong.n_memories))
