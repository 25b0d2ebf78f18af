"""Components of policies: image encoders, tokens, networks over time, action heads, augmentation."""

from lifelong.nn.augmentation import Augmentation, ColorJitter, Compose, RandomShift
from lifelong.nn.flow import FlowHead
from lifelong.nn.heads import ActionHead, DeterministicHead, GMMHead
from lifelong.nn.tokens import LanguageToken, ProprioScaling, ProprioTokens
from lifelong.nn.transformer import SpatialTransformer, TemporalLSTM, TemporalTransformer
from lifelong.nn.vision import FiLM, PatchEncoder, ResNetFiLMEncoder, SpatialSoftmax

__all__ = [
    "ActionHead",
    "Augmentation",
    "ColorJitter",
    "Compose",
    "DeterministicHead",
    "FiLM",
    "FlowHead",
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
