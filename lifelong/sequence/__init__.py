"""The task sequence of a run."""

from lifelong.sequence.learning import TaskSequence
from lifelong.sequence.stages import is_measured

__all__ = ["TaskSequence", "is_measured"]
