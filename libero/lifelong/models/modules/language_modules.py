"""From the instruction's embedding to what a policy takes of it.

Shape legend: B batch, S parts of an instruction, L language embedding, E output.
"""

from collections.abc import Mapping

from torch import Tensor, nn

from lifelong.errors import PolicyError

__all__ = ["CLIPEncoder", "IdentityEncoder", "MLPEncoder", "RNNEncoder"]


class IdentityEncoder(nn.Module):
    """The embedding as it is."""

    def __init__(self, dummy: bool = True, input_size: int | None = None):
        super().__init__()

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """(B, L), by itself or under `task_emb`, -> (B, L)."""
        return embedding(data)


class MLPEncoder(nn.Module):
    """`num_layers` linear layers with ReLU between them.

    Args:
        input_size, hidden_size, output_size: L, of the layers between, E.
        num_layers: 1 is a linear map.
    """

    def __init__(self, input_size: int, hidden_size: int, num_layers: int, output_size: int):
        super().__init__()
        self.projection = mlp(input_size, hidden_size, num_layers, output_size)

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """(B, L), by itself or under `task_emb`, -> (B, E)."""
        return self.projection(embedding(data))


class CLIPEncoder(MLPEncoder):
    """The same for CLIP's embeddings, which are 512 numbers."""

    def __init__(
        self, input_size: int = 512, hidden_size: int = 128, num_layers: int = 1, output_size: int = 128
    ):
        super().__init__(input_size, hidden_size, num_layers, output_size)


class RNNEncoder(nn.Module):
    """A recurrent layer over the parts of an instruction, and a linear map of its last state."""

    def __init__(self, input_size: int, hidden_size: int, num_layers: int, output_size: int):
        super().__init__()
        self.rnn = nn.GRU(input_size, hidden_size, num_layers, batch_first=True)
        self.projection = nn.Linear(hidden_size, output_size)

    def forward(self, data: Mapping[str, Tensor] | Tensor) -> Tensor:
        """(B, S, L), or (B, L) for S = 1, by itself or under `task_emb`, -> (B, E)."""
        parts = embedding(data)
        states = self.rnn(parts[:, None] if parts.dim() == 2 else parts)[0]
        return self.projection(states[:, -1])


ENCODERS = {kind.__name__: kind for kind in (IdentityEncoder, MLPEncoder, CLIPEncoder, RNNEncoder)}


def embedding(data: Mapping[str, Tensor] | Tensor) -> Tensor:
    """The instruction's embedding, by itself or out of a batch."""
    return data if isinstance(data, Tensor) else data["task_emb"]


def mlp(input_size: int, hidden_size: int, num_layers: int, output_size: int) -> nn.Sequential:
    """`num_layers` linear layers with ReLU between them.

    Raises:
        PolicyError: fewer than one.
    """
    if num_layers < 1:
        raise PolicyError(f"num_layers is {num_layers}; it must be at least 1")
    sizes = [input_size, *[hidden_size] * (num_layers - 1), output_size]
    layers: list[nn.Module] = []
    for one, other in zip(sizes, sizes[1:], strict=False):
        layers += [nn.Linear(one, other), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
