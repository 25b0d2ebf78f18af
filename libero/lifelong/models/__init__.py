"""The original's policies, networks of `lifelong.policies` whose batches are dictionaries, and their modules."""

from libero._adapters.lookup import alias_modules
from libero.lifelong.models.base_policy import BasePolicy, get_policy_class, get_policy_list
from libero.lifelong.models.modules.language_modules import IdentityEncoder, MLPEncoder
from libero.lifelong.models.modules.rgb_modules import PatchEncoder, ResnetEncoder
from libero.lifelong.models.modules.transformer_modules import SinusoidalPositionEncoding, TransformerDecoder
from libero.lifelong.models.native_policy import (
    BCRNNPolicy,
    BCTransformerPolicy,
    BCViLTPolicy,
    ExtraModalities,
    ExtraModalityTokens,
)
from libero.lifelong.models.policy_head import DeterministicHead, GMMHead

alias_modules(__name__, "bc_rnn_policy bc_transformer_policy bc_vilt_policy policy")
