"""Arenas by class."""

from typing import Any

from libero.libero.envs.arenas.base_arena import Arena, WorkspaceArena


def _arena(name: str, category: str) -> Any:
    """Return the class of the arena of a workspace."""
    return type(name, (WorkspaceArena,), {"__module__": __name__, "category": category})


CoffeeTableArena = _arena("CoffeeTableArena", "coffee_table")
EmptyArena = _arena("EmptyArena", "floor")
KitchenTableArena = _arena("KitchenTableArena", "kitchen_table")
LivingRoomTableArena = _arena("LivingRoomTableArena", "living_room_table")
StudyTableArena = _arena("StudyTableArena", "study_table")
TableArena = _arena("TableArena", "table")
