"""Every error this package raises on purpose derives from `LifelongError`."""

from libero_env.errors import LiberoError


class LifelongError(LiberoError):
    """Root of the learning side's errors: the message says what is wrong, where, and how to mend it."""


class ConfigError(LifelongError, ValueError):
    """A configuration that cannot be run, or that is not the one a run directory was made with."""


class CheckpointError(LifelongError, ValueError):
    """A checkpoint that is missing, broken, or does not fit the model it is loaded into."""


class TrainingError(LifelongError, RuntimeError):
    """Training that cannot go on: the loss is not finite, the dataset is empty."""
