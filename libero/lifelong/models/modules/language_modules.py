"""Encoders of the instruction's embedding.

Shape legend: B batch, L language embedding, E output.
"""

from collections.abc import Mapping
from itertools import pairwise

from torch import Tensor, nn

from lifelong.errors import PolicyError


class IdentityEncoder(nn.Module):
    """Returns the embedding unchanged."""

    def __init__(self, dummy: bool = True, input_size: int | None = None):
        super().__init__()

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """Return the embedding (B, L), which is given alone or under `task_emb`."""
        return _embedding(data)


class MLPEncoder(nn.Module):
    """`num_layers` linear layers with ReLU between them."""

    def __init__(self, input_size: int, hidden_size: int, output_size: int, num_layers: int):
        super().__init__()
        self.projection = mlp(input_size, hidden_size, output_size, num_layers)

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """Encode an embedding (B, L), alone or under `task_emb`, as (B, E)."""
        return self.projection(_embedding(data))


ENCODERS = {kind.__name__: kind for kind in (IdentityEncoder, MLPEncoder)}


def _embedding(data: Mapping[str, Tensor] | Tensor) -> Tensor:
    return data if isinstance(data, Tensor) else data["task_emb"]


def mlp(input_size: int, hidden_size: int, output_size: int, num_layers: int) -> nn.Sequential:
    """Return `num_layers` linear layers, at least one, with ReLU between them."""
    if num_layers < 1:
        raise PolicyError(f"num_layers is {num_layers}; it must be at least 1")
    sizes = [input_size, *[hidden_size] * (num_layers - 1), output_size]
    layers = [layer for size in pairwise(sizes) for layer in (nn.Linear(*size), nn.ReLU())]
    return nn.Sequential(*layers[:-1])
