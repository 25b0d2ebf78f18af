"""Rooms by class."""

from libero.libero.envs.arenas.base_arena import Arena, WorkspaceArena
from libero.libero.envs.arenas.coffee_table_arena import CoffeeTableArena
from libero.libero.envs.arenas.empty_arena import EmptyArena
from libero.libero.envs.arenas.kitchen_arena import KitchenTableArena
from libero.libero.envs.arenas.living_room_arena import LivingRoomTableArena
from libero.libero.envs.arenas.study_arena import StudyTableArena
from libero.libero.envs.arenas.table_arena import TableArena
