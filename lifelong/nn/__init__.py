"""Network parts that policies are made of: vision, tokens, transformer over time, action heads, augmentation."""

from lifelong.nn.augmentation import Augmentation, ColorJitter, Compose, RandomShift
from lifelong.nn.flow import FlowHead
from lifelong.nn.heads import ActionHead, DeterministicHead, GMMHead
from lifelong.nn.patches import PatchEncoder, SpatialTransformer
from lifelong.nn.tokens import LanguageToken, ProprioScaling, ProprioTokens
from lifelong.nn.transformer import TemporalTransformer
from lifelong.nn.vision import FiLM, ResNetFiLMEncoder, SpatialSoftmax

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
    "TemporalTransformer",
]
