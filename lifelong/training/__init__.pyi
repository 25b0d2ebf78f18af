from .fit import EpochEnd, learning_rate
from .settings import FitSettings
from .step import BatchAugmentation, Step

__all__ = ["BatchAugmentation", "EpochEnd", "FitSettings", "Step", "learning_rate"]
