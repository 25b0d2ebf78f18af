from .log import ResultLog
from .results import Results
from .run_directory import RunDirectory
from .summary import write_summary

__all__ = ["ResultLog", "Results", "RunDirectory", "write_summary"]
