"""A living room table."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Living_Room_Tabletop_Manipulation(BDDLBaseDomain):
    """A living room table; the scene follows from the task file."""
