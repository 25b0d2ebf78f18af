from .environments import EnvPool, VectorEnv
from .restore import restore
from .rollout import Episode, Rollouts, save_animation
from .settings import EvalSettings

__all__ = [
    "EnvPool",
    "Episode",
    "EvalSettings",
    "Rollouts",
    "VectorEnv",
    "restore",
    "save_animation",
]
