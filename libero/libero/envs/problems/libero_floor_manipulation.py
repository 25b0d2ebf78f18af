"""The floor."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Floor_Manipulation(BDDLBaseDomain):
    """The floor; the scene follows from the task file."""
