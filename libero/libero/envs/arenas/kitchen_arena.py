"""A kitchen table."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class KitchenTableArena(WorkspaceArena):
    """A kitchen table with its room."""

    category = "kitchen_table"
