"""A table."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Tabletop_Manipulation(BDDLBaseDomain):
    """A table; the scene follows from the task file."""
