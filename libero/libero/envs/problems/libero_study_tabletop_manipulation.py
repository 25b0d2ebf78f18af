"""A study table."""

from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, register_problem


@register_problem
class Libero_Study_Tabletop_Manipulation(BDDLBaseDomain):
    """A study table; the scene follows from the task file."""
