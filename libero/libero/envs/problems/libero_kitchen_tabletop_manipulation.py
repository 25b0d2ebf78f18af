"""A kitchen table."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Kitchen_Tabletop_Manipulation(BDDLBaseDomain):
    """A kitchen table; the scene follows from the task file."""
