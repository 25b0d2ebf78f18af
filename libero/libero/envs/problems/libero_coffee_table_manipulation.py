"""A coffee table."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Coffee_Table_Manipulation(BDDLBaseDomain):
    """A coffee table; the scene follows from the task file."""
