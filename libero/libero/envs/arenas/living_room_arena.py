"""A living room table."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class LivingRoomTableArena(WorkspaceArena):
    """A living room table with its room."""

    category = "living_room_table"
