"""Sequential fine-tuning, the lower bound: nothing is done against forgetting."""

from lifelong.algorithms.base import Algorithm


class Sequential(Algorithm):
    """Train on each task in turn, starting from the weights the last one left (LIBERO, section 4: SeqL)."""

    plain_start = True
