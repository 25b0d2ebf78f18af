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


class LanguageError(LifelongError, ValueError):
    """An instruction that cannot be embedded; the message names the remedy."""


class DataError(LifelongError, ValueError):
    """Demonstrations that do not fit the policy's spec; the message names file, key, and what was expected."""


class PolicyError(LifelongError, ValueError):
    """A policy built or used in a way it cannot work; the message says what would be valid."""


class ResultsError(LifelongError):
    """Results that cannot be read or written; the message names the file and what is missing."""
