"""Policies small enough to train within a test."""

from functools import partial
from typing import Any

from lifelong.nn import (
    DeterministicHead,
    FlowHead,
    GMMHead,
    PatchEncoder,
    ResNetFiLMEncoder,
    SpatialTransformer,
    TemporalLSTM,
    TemporalTransformer,
)
from lifelong.policies import BCMLP, BCRNN, BCTransformer, BCViLT
from lifelong.types import PolicySpec

small_resnet = partial(ResNetFiLMEncoder, width=8, stage_blocks=[1], stem_pool=False)


def small_head(kind: str = "gmm", **changes: Any) -> partial:
    """Return a head of one layer as a component; of the changes those that concern its kind."""
    sizes = {"hidden": 8, "layers": 1, "modes": 2, "min_std": 0.05, "chunk": 2, "execute": 1, "steps": 2}
    sizes |= changes
    target, own = {
        "gmm": (GMMHead, ("modes", "min_std")),
        "deterministic": (DeterministicHead, ()),
        "flow": (FlowHead, ("chunk", "execute", "steps")),
    }[kind]
    return partial(target, **{key: sizes[key] for key in ("hidden", "layers", *own)})


def small_transformer(
    spec: PolicySpec, head: str | partial = "gmm", dropout: float = 0.1, **changes: Any
) -> BCTransformer:
    """Return a ResNet-T of one layer with tokens of eight numbers."""
    temporal = partial(TemporalTransformer, layers=1, heads=2, head_dim=4, mlp_dim=8, dropout=dropout)
    head = small_head(head) if isinstance(head, str) else head
    components = {"embed_dim": 8, "encoder": small_resnet, "temporal": temporal, "head": head}
    return BCTransformer(spec=spec, **(components | changes))


def small_rnn(spec: PolicySpec, head: str | partial = "gmm", **changes: Any) -> BCRNN:
    """Return a ResNet-RNN with a state of eight numbers."""
    temporal = partial(TemporalLSTM, hidden=8, layers=2)
    head = small_head(head) if isinstance(head, str) else head
    components = {"encoder": small_resnet, "temporal": temporal, "head": head}
    return BCRNN(spec=spec, **({"image_embed": 8, "text_embed": 4} | components | changes))


def small_mlp(spec: PolicySpec, head: str | partial = "gmm", **changes: Any) -> BCMLP:
    """Return a ResNet-MLP with a latent of eight numbers for each camera."""
    head = small_head(head) if isinstance(head, str) else head
    components = {"encoder": small_resnet, "head": head, "image_embed": 8, "text_embed": 4}
    return BCMLP(spec=spec, **(components | changes))


def small_vilt(spec: PolicySpec, head: str | partial = "gmm", dropout: float = 0.1, **changes: Any) -> BCViLT:
    """Return a ViT-T of one layer each way, for images whose sides are multiples of four pixels."""
    sizes = {"layers": 1, "heads": 2, "head_dim": 4, "mlp_dim": 8, "dropout": dropout}
    components = {
        "encoder": partial(PatchEncoder, width=8, stem_kernel=3, stem_stride=1, patch=4),
        "spatial": partial(SpatialTransformer, **sizes),
        "temporal": partial(TemporalTransformer, **sizes),
        "head": small_head(head) if isinstance(head, str) else head,
    }
    return BCViLT(spec=spec, **({"patch_embed": 8, "embed_dim": 8} | components | changes))
