"""Path of the original; see `libero.libero.envs.arenas`."""

from libero.libero.envs.arenas import TableArena  # noqa: F401
