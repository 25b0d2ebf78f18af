"""Policies: from observations and an instruction to actions."""

from lifelong.policies.base import Policy
from lifelong.policies.bc_transformer import BCTransformer

__all__ = ["BCTransformer", "Policy"]
