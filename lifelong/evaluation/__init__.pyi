from .environments import EnvPool, VectorEnv
from .restore import LoadedRun, restore
from .rollout import Episode, Rollouts, run_episodes, save_animation
from .settings import EvalSettings

__all__ = [
    "EnvPool",
    "Episode",
    "EvalSettings",
    "LoadedRun",
    "Rollouts",
    "VectorEnv",
    "restore",
    "run_episodes",
    "save_animation",
]
