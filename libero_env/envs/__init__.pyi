from .batch import BatchEnv
from .config import EnvConfig
from .env import LiberoEnv

__all__ = ["BatchEnv", "EnvConfig", "LiberoEnv"]
