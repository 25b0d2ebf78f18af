"""The registry, under its second path."""

from libero.libero.envs.base_object import *  # noqa: F403
