from .log import ResultLog
from .metrics import lifelong_metrics, wilson_interval
from .results import Results
from .run_directory import RunDirectory
from .summary import write_summary

__all__ = [
    "ResultLog",
    "Results",
    "RunDirectory",
    "lifelong_metrics",
    "wilson_interval",
    "write_summary",
]
