"""The task sequence of a run."""

from lifelong.sequence.learning import TaskSequence

__all__ = ["TaskSequence"]
