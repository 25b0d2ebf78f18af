"""Modules of transformers.

Shape legend: B batch, T time, M tokens per time step, N tokens, E token.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.transformer import (
    TransformerLayer,
    attend,
    block_causal_mask,
    drop_samples,
    sinusoidal_positions,
)


class SinusoidalPositionEncoding(nn.Module):
    """Codes of time steps, times a learned factor that begins as `factor_ratio`, if that is given.

    See `lifelong.nn.transformer.sinusoidal_positions`.
    """

    def __init__(self, input_size: int, inv_freq_factor: float = 10, factor_ratio: float | None = None):
        super().__init__()
        self.input_size, self.inv_freq_factor = input_size, inv_freq_factor
        self.factor = 1.0 if factor_ratio is None else nn.Parameter(torch.tensor([float(factor_ratio)]))

    def forward(self, x: Tensor) -> Tensor:
        """Return the codes (T, E) of the time steps of x, (B, T, ...)."""
        return (
            sinusoidal_positions(x.shape[1], self.input_size, self.inv_freq_factor).to(x.device) * self.factor
        )

    def output_shape(self, input_shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the given shape."""
        return input_shape


class Norm(nn.Module):
    """Layer normalisation, (..., E) -> (..., E)."""

    def __init__(self, dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(x)


class Attention(nn.Module):
    """Self-attention of `num_heads` heads of size `head_output_size`, with dropout of weights and output."""

    def __init__(self, dim: int, num_heads: int = 8, head_output_size: int = 64, dropout: float = 0.0):
        super().__init__()
        self.num_heads, self.head_output_size, self.dropout = num_heads, head_output_size, dropout
        self.qkv = nn.Linear(dim, 3 * num_heads * head_output_size, bias=False)
        self.output_layer = nn.Sequential(nn.Linear(num_heads * head_output_size, dim), nn.Dropout(dropout))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """Map (B, N, E) to (B, N, E); the mask, see `_of_heads`, is true where a token may attend."""
        dropout = self.dropout if self.training else 0.0
        return self.output_layer(attend(self.qkv(x), self.num_heads, _of_heads(mask), dropout))


def _of_heads(mask: Tensor | None) -> Tensor | None:
    """Return a mask of tokens (B, N), or of pairs (1, N, N) or (B, N, N), with an axis for the heads."""
    if mask is None:
        return None
    return (mask[:, None, None] if mask.dim() == 2 else mask[:, None]).bool()


class TransformerFeedForwardNN(nn.Module):
    """Layers between two attentions, (..., E) -> (..., E)."""

    def __init__(self, dim: int, hidden_dim: int, dropout: float = 0.0):
        super().__init__()
        layers = (nn.Linear(dim, hidden_dim), nn.GELU(), nn.Dropout(dropout), nn.Linear(hidden_dim, dim))
        self.net = nn.Sequential(*layers, nn.Dropout(dropout))

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x)


class DropPath(nn.Module):
    """Drops a branch of a residual network for random rows in training (Huang et al., ECCV 2016).

    `drop_prob` is the probability for a row; the other rows are scaled so that the mean stays.
    """

    def __init__(self, drop_prob: float | None = None):
        super().__init__()
        self.drop_prob = drop_prob or 0.0

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, ...) to (B, ...)."""
        return drop_samples(x, self.drop_prob, self.training)


class TransformerDecoder(nn.Module):
    """`num_layers` layers of `lifelong.nn.transformer.TransformerLayer`."""

    def __init__(
        self,
        input_size: int,
        num_layers: int,
        num_heads: int,
        head_output_size: int,
        mlp_hidden_size: int,
        dropout: float,
        **_: object,
    ):
        super().__init__()
        sizes = {"dim": input_size, "heads": num_heads, "head_dim": head_output_size}
        self.layers = nn.ModuleList(
            TransformerLayer(**sizes, mlp_dim=mlp_hidden_size, dropout=dropout) for _ in range(num_layers)
        )
        self.mask: Tensor | None = None

    def compute_mask(self, input_shape: tuple[int, ...]) -> None:
        """Make tokens attend to their own time step and earlier ones; input_shape is (B, T, M, E)."""
        self.mask = block_causal_mask(input_shape[1], input_shape[2])[None]

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """Map (B, N, E) to (B, N, E), with the given mask, else that of `compute_mask`."""
        mask = _of_heads(self.mask if mask is None else mask)
        for layer in self.layers:
            x = layer(x, None if mask is None else mask.to(x.device))
        return x
