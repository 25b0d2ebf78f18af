"""Problem classes, by the name that task files give; their scenes follow from the task file."""

from typing import Any

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
