"""Problem classes, by the name that task files give; their scenes follow from the task file."""

from typing import Any

from libero._adapters.lookup import alias_modules
from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


def _problem(name: str) -> Any:
    """Return a registered problem class."""
    return register_problem(type(name, (BDDLBaseDomain,), {"__module__": __name__, "__doc__": f"`{name}`"}))


Libero_Coffee_Table_Manipulation = _problem("Libero_Coffee_Table_Manipulation")
Libero_Floor_Manipulation = _problem("Libero_Floor_Manipulation")
Libero_Kitchen_Tabletop_Manipulation = _problem("Libero_Kitchen_Tabletop_Manipulation")
Libero_Living_Room_Tabletop_Manipulation = _problem("Libero_Living_Room_Tabletop_Manipulation")
Libero_Study_Tabletop_Manipulation = _problem("Libero_Study_Tabletop_Manipulation")
Libero_Tabletop_Manipulation = _problem("Libero_Tabletop_Manipulation")

alias_modules(
    __name__,
    libero_coffee_table_manipulation="Libero_Coffee_Table_Manipulation",
    libero_floor_manipulation="Libero_Floor_Manipulation",
    libero_kitchen_tabletop_manipulation="Libero_Kitchen_Tabletop_Manipulation",
    libero_living_room_tabletop_manipulation="Libero_Living_Room_Tabletop_Manipulation",
    libero_study_tabletop_manipulation="Libero_Study_Tabletop_Manipulation",
    libero_tabletop_manipulation="Libero_Tabletop_Manipulation",
)
