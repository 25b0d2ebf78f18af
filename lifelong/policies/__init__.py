"""Policies: from observations and an instruction to actions."""

from lifelong.policies.base import Policy
from lifelong.policies.bc_mlp import BCMLP
from lifelong.policies.bc_rnn import BCRNN
from lifelong.policies.bc_transformer import BCTransformer
from lifelong.policies.bc_vilt import BCViLT

__all__ = ["BCMLP", "BCRNN", "BCTransformer", "BCViLT", "Policy"]
