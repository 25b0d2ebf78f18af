"""Tokens of the instruction and of proprioception, and features divided by modality.

Shape legend: B batch, T time, L language embedding, D one modality's dimension, E token.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import PolicyError

# Fixed centre and scale per modality, so that inputs are of order one from the first task on and no statistic
# drifts from task to task: rest pose of the arm [rad], half the finger travel [m], the workspace [m].
_CENTRE_AND_SCALE: dict[str, tuple[tuple[float, ...], float]] = {
    "joint_states": ((0.0, -0.161, 0.0, -2.4446, 0.0, 2.2268, 0.7854), 0.5),
    "gripper_states": ((0.02, -0.02), 0.02),
    "ee_pos": ((0.0, 0.0, 0.3), 0.25),
}


class ProprioScaling(nn.Module):
    """Scaling of readings to order one, and dropout of whole modalities.

    Args:
        proprio: Name -> D, in order.
        normalise: Whether to bring known modalities to order one (the original feeds raw radians and metres, in
            which the gripper's 0.04 m all but vanish).
        dropout: Chance, in training, that a whole modality of a whole window is zeroed, so that the policy
            does not learn to read the action off the arm's pose alone.
        measured: Whether modalities are brought to mean 0 and variance 1 by statistics, see `take`, which are stored
            with the weights.

    Raises:
        PolicyError: Readings are not to be normalised, and there are statistics for it.
    """

    def __init__(
        self,
        *,
        proprio: Mapping[str, int],
        normalise: bool = True,
        dropout: float = 0.0,
        measured: bool = False,
    ) -> None:
        super().__init__()
        if measured and not normalise:
            raise PolicyError(
                "policy.normalise_proprio=false leaves readings as they are, and data.statistics says what normalises "
                "them; set data.statistics=constants or policy.normalise_proprio=true"
            )
        self.names, self.dropout = tuple(proprio), dropout
        if measured:
            self.register_buffer("taken", torch.tensor(False))
        for name, size in proprio.items():
            centre, scale = _CENTRE_AND_SCALE.get(name, ((0.0,) * size, 1.0))
            if not normalise or measured or len(centre) != size:
                centre, scale = (0.0,) * size, 1.0
            scales = torch.full((size,), scale) if measured else torch.tensor(scale)
            self.register_buffer(f"centre_{name}", torch.tensor(centre), persistent=measured)
            self.register_buffer(f"scale_{name}", scales, persistent=measured)

    def take(self, mean: Tensor, deviation: Tensor, *, once: bool) -> None:
        """Normalise by these statistics from now on.

        Args:
            mean: Means of all modalities in order, (sum of D).
            deviation: Their standard deviations; what does not vary is left as large as it is.
            once: Whether statistics that were taken before are kept.
        """
        if once and bool(self.taken):
            return
        sizes = [len(getattr(self, f"centre_{name}")) for name in self.names]
        scale = torch.where(deviation > 1e-6, deviation, 1.0)
        for name, m, s in zip(self.names, mean.split(sizes), scale.split(sizes), strict=True):
            getattr(self, f"centre_{name}").copy_(m)
            getattr(self, f"scale_{name}").copy_(s)
        self.taken.fill_(True)

    def forward(self, proprio: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Scale the readings, name -> (B, T, D); in order."""
        scaled = {}
        for name in self.names:
            x = (proprio[name] - getattr(self, f"centre_{name}")) / getattr(self, f"scale_{name}")
            if self.training and self.dropout > 0:
                x = x * (torch.rand(x.shape[0], 1, 1, device=x.device) >= self.dropout)
            scaled[name] = x
        return scaled


class ProprioTokens(nn.Module):
    """One token per modality: a linear map to E numbers (`dim`) of the reading, scaled by `ProprioScaling`."""

    def __init__(self, *, proprio: Mapping[str, int], dim: int, **scaling: Any) -> None:
        super().__init__()
        self.scaling = ProprioScaling(proprio=proprio, **scaling)
        self.linears = nn.ModuleDict({name: nn.Linear(size, dim) for name, size in proprio.items()})

    def forward(self, proprio: Mapping[str, Tensor]) -> list[Tensor]:
        """Map readings, name -> (B, T, D), to one token each, (B, T, E); in order."""
        scaled = self.scaling(proprio)
        return [linear(scaled[name]) for name, linear in self.linears.items()]


class LanguageToken(nn.Module):
    """One token for the instruction: a linear map of its embedding."""

    def __init__(self, *, language_dim: int, dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(language_dim, dim)

    def forward(self, language: Tensor) -> Tensor:
        """Map embeddings (B, L) to tokens (B, E)."""
        return self.linear(language)


def named_parts(features: Tensor, sizes: Mapping[str, int], dim: int) -> dict[str, Tensor]:
    """Return the parts of features along an axis by name, given the size of each in order; without empty ones."""
    parts = zip(sizes, features.split(list(sizes.values()), dim=dim), strict=True)
    return {name: part for name, part in parts if part.shape[dim]}


def standardise(language: Tensor) -> Tensor:
    """Return embeddings (B, L) with mean 0 and variance 1 over L.

    Sentence encoders give unit vectors, whose 384 entries are of order 0.05; BERT's are of order one. This
    makes a learning rate mean the same for all of them.
    """
    return functional.layer_norm(language, language.shape[-1:])
