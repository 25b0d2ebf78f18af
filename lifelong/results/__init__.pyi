from .log import ResultLog
from .metrics import lifelong_metrics, wilson_interval
from .results import Results
from .summary import write_summary

__all__ = [
    "ResultLog",
    "Results",
    "lifelong_metrics",
    "wilson_interval",
    "write_summary",
]
