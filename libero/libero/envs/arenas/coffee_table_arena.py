"""A coffee table."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class CoffeeTableArena(WorkspaceArena):
    """A coffee table with its room."""

    category = "coffee_table"
