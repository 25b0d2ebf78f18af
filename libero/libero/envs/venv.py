"""Several environments together, with the interface that the original took from Tianshou."""

from libero._adapters.envs.subproc_worker import SubprocEnvWorker
from libero._adapters.envs.vector_env import BaseVectorEnv, DummyVectorEnv, SubprocVectorEnv
from libero._adapters.envs.workers import CloudpickleWrapper, DummyEnvWorker, EnvWorker, ShArray

__all__ = [
    "BaseVectorEnv",
    "CloudpickleWrapper",
    "DummyEnvWorker",
    "DummyVectorEnv",
    "EnvWorker",
    "ShArray",
    "SubprocEnvWorker",
    "SubprocVectorEnv",
]
