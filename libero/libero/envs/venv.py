"""Several environments together, with the interface that the original took from Tianshou."""

from libero.libero.envs.subproc_worker import SubprocEnvWorker
from libero.libero.envs.vector_env import BaseVectorEnv, DummyVectorEnv, SubprocVectorEnv
from libero.libero.envs.workers import (
    CloudpickleWrapper,
    DummyEnvWorker,
    EnvWorker,
    ShArray,
)

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
