from .base import Policy
from .bc_mlp import BCMLP
from .bc_rnn import BCRNN
from .bc_transformer import BCTransformer
from .bc_vilt import BCViLT

__all__ = ["BCMLP", "BCRNN", "BCTransformer", "BCViLT", "Policy"]
