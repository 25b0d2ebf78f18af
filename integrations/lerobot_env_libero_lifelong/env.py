"""EnvHub: `lerobot.envs.make_env("USER/REPOSITORY", trust_remote_code=True)` loads this file from a repository."""

from lerobot_env_libero_lifelong import LiberoLifelongEnv
from lerobot_env_libero_lifelong.vector import TaskEnvs

SUITES = "libero_spatial,libero_object,libero_goal,libero_10,libero_90"


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: LiberoLifelongEnv | None = None
) -> dict[str, dict[int, TaskEnvs]]:
    """Return the environments of each task by suite and index; none is built before it is used.

    Args:
        n_envs: Number of simulations of a task.
        use_async_envs: Whether images are rendered in processes.
        cfg: Options, of `--env.type=libero_lifelong`; without them the tasks of all suites.

    Raises:
        TypeError: The options are those of another type.
    """
    if cfg is None:
        cfg = LiberoLifelongEnv(task=SUITES)
    if not isinstance(cfg, LiberoLifelongEnv):
        raise TypeError(f"--env.type is {cfg.type}; this repository takes --env.type=libero_lifelong")
    return cfg.create_envs(n_envs, use_async_envs)
