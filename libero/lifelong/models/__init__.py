"""The original's policies: networks of `lifelong.policies` whose batches are dictionaries."""

from libero.lifelong.models.base_policy import BasePolicy, get_policy_class, get_policy_list
from libero.lifelong.models.bc_rnn_policy import BCRNNPolicy
from libero.lifelong.models.bc_transformer_policy import BCTransformerPolicy
from libero.lifelong.models.bc_vilt_policy import BCViLTPolicy
