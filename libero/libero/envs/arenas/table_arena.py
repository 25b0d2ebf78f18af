"""A table."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class TableArena(WorkspaceArena):
    """A table with its room."""

    category = "table"
