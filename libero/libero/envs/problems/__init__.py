"""Problem classes, by the name that task files give."""

from libero.libero.envs.problems.libero_coffee_table_manipulation import Libero_Coffee_Table_Manipulation
from libero.libero.envs.problems.libero_floor_manipulation import Libero_Floor_Manipulation
from libero.libero.envs.problems.libero_kitchen_tabletop_manipulation import (
    Libero_Kitchen_Tabletop_Manipulation,
)
from libero.libero.envs.problems.libero_living_room_tabletop_manipulation import (
    Libero_Living_Room_Tabletop_Manipulation,
)
from libero.libero.envs.problems.libero_study_tabletop_manipulation import Libero_Study_Tabletop_Manipulation
from libero.libero.envs.problems.libero_tabletop_manipulation import Libero_Tabletop_Manipulation
