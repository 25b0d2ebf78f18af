"""Lifelong-learning algorithms: what each adds to the one training loop, one class per file."""

from lifelong.algorithms.base import Algorithm, Phase
from lifelong.algorithms.er import ER
from lifelong.algorithms.ewc import EWC
from lifelong.algorithms.packnet import PackNet
from lifelong.algorithms.sequential import Sequential

__all__ = ["ER", "EWC", "Algorithm", "PackNet", "Phase", "Sequential"]
