"""The floor."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class EmptyArena(WorkspaceArena):
    """The floor with its room."""

    category = "floor"
