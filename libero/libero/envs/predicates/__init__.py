"""Predicates on object states; their truth is that of `libero_env.sim.predicates`."""

from libero.libero.envs.predicates.base_predicates import *  # noqa: F403
from libero.libero.envs.predicates.registry import *  # noqa: F403
