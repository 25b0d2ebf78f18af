"""All policies, and the modules they are assembled from."""

from libero.lifelong.models import get_policy_class, get_policy_list
from libero.lifelong.models.base_policy import BasePolicy
from libero.lifelong.models.bc_rnn_policy import BCRNNPolicy, ExtraModalities
from libero.lifelong.models.bc_transformer_policy import BCTransformerPolicy, ExtraModalityTokens
from libero.lifelong.models.bc_vilt_policy import BCViLTPolicy
from libero.lifelong.models.modules.language_modules import IdentityEncoder, MLPEncoder
from libero.lifelong.models.modules.rgb_modules import (
    PatchEncoder,
    ResnetEncoder,
    SpatialProjection,
    SpatialSoftmax,
)
from libero.lifelong.models.modules.transformer_modules import (
    Attention,
    DropPath,
    Norm,
    SinusoidalPositionEncoding,
    TransformerDecoder,
    TransformerFeedForwardNN,
)
from libero.lifelong.models.policy_head import DeterministicHead, GMMHead
from libero.lifelong.models.saliency import PerturbationAttention
