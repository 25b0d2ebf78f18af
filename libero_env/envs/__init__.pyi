from .batch import BatchEnv
from .env import LiberoEnv
from .subproc import SubprocEnv, WorkerError

__all__ = [
    "BatchEnv",
    "LiberoEnv",
    "SubprocEnv",
    "WorkerError",
]
