from .algorithms.base import Algorithm
from .errors import LifelongError
from .evaluation.rollout import rollout
from .evaluation.settings import EvalSettings
from .policies.base import Policy
from .report.export import load_runs
from .report.page import write_report
from .stats.metrics import lifelong_metrics
from .training.fit import fit
from .training.settings import FitSettings
from .types import Batch, PolicySpec

__all__ = [
    "Algorithm",
    "Batch",
    "EvalSettings",
    "FitSettings",
    "LifelongError",
    "Policy",
    "PolicySpec",
    "fit",
    "lifelong_metrics",
    "load_runs",
    "rollout",
    "write_report",
]

__distribution__: str
__version__: str
