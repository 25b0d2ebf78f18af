"""Problem classes, by the name that task files give; their scenes follow from the task file."""

from libero._adapters.lookup import alias_modules
from libero.libero.envs.bddl_base_domain import TASK_MAPPING, BDDLBaseDomain, register_problem  # noqa: F401
from libero_env.parallel import send_to_workers

_KINDS = "Coffee_Table Floor Kitchen_Tabletop Living_Room_Tabletop Study_Tabletop Tabletop"
for _name in [f"Libero_{kind}_Manipulation" for kind in _KINDS.split()]:
    _class = type(_name, (BDDLBaseDomain,), {"__module__": __name__, "__doc__": f"`{_name}`"})
    globals()[_name] = register_problem(_class)
    alias_modules(__name__, _name.lower())
send_to_workers(__name__, "TASK_MAPPING")
