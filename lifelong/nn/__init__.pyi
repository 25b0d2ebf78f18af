from .augmentation import Augmentation, ColorJitter, Compose, RandomShift
from .flow import FlowHead
from .frozen import FrozenEncoder
from .heads import ActionHead, DeterministicHead, GMMHead
from .tokens import LanguageToken, ProprioScaling, ProprioTokens
from .transformer import SpatialTransformer, TemporalLSTM, TemporalTransformer
from .vision import FiLM, PatchEncoder, ResNetFiLMEncoder, SpatialSoftmax

__all__ = [
    "ActionHead",
    "Augmentation",
    "ColorJitter",
    "Compose",
    "DeterministicHead",
    "FiLM",
    "FlowHead",
    "FrozenEncoder",
    "GMMHead",
    "LanguageToken",
    "PatchEncoder",
    "ProprioScaling",
    "ProprioTokens",
    "RandomShift",
    "ResNetFiLMEncoder",
    "SpatialSoftmax",
    "SpatialTransformer",
    "TemporalLSTM",
    "TemporalTransformer",
]
