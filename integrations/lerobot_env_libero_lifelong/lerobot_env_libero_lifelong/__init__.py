"""LIBERO's tasks for LeRobot: importing this package registers the environment type `libero_lifelong`."""

from lerobot_env_libero_lifelong.config import LiberoLifelongEnv

__all__ = ["LiberoLifelongEnv"]
