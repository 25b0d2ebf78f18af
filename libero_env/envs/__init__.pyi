from .batch import BatchEnv
from .config import EnvConfig
from .env import LiberoEnv
from .subproc import SubprocEnv, WorkerError

__all__ = ["BatchEnv", "EnvConfig", "LiberoEnv", "SubprocEnv", "WorkerError"]
