"""Encoders of the instruction's embedding.

Shape legend: B batch, S parts of an instruction, L language embedding, E output.
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


class CLIPEncoder(MLPEncoder):
    """`MLPEncoder` with the sizes of CLIP's embeddings."""

    def __init__(
        self, input_size: int = 512, hidden_size: int = 128, output_size: int = 128, num_layers: int = 1
    ):
        super().__init__(input_size, hidden_size, output_size, num_layers)


class RNNEncoder(nn.Module):
    """GRU over the parts of an instruction, and a linear map of its last state."""

    def __init__(self, input_size: int, hidden_size: int, output_size: int, num_layers: int):
        super().__init__()
        self.rnn = nn.GRU(input_size, hidden_size, num_layers, batch_first=True)
        self.projection = nn.Linear(hidden_size, output_size)

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """Encode (B, S, L), or (B, L) for S = 1, alone or under `task_emb`, as (B, E)."""
        parts = _embedding(data)
        states = self.rnn(parts[:, None] if parts.dim() == 2 else parts)[0]
        return self.projection(states[:, -1])


ENCODERS = {kind.__name__: kind for kind in (IdentityEncoder, MLPEncoder, CLIPEncoder, RNNEncoder)}


def _embedding(data: Mapping[str, Tensor] | Tensor) -> Tensor:
    return data if isinstance(data, Tensor) else data["task_emb"]


def mlp(input_size: int, hidden_size: int, output_size: int, num_layers: int) -> nn.Sequential:
    """Return `num_layers` linear layers, at least one, with ReLU between them."""
    if num_layers < 1:
        raise PolicyError(f"num_layers is {num_layers}; it must be at least 1")
    sizes = [input_size, *[hidden_size] * (num_layers - 1), output_size]
    layers = [layer for size in pairwise(sizes) for layer in (nn.Linear(*size), nn.ReLU())]
    return nn.Sequential(*layers[:-1])
