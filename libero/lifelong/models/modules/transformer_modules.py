"""Modules of transformers.

Shape legend: B batch, T time, M tokens per time step, N tokens, E token.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.transformer import TransformerLayer, block_causal_mask, sinusoidal_positions


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


def _of_heads(mask: Tensor | None) -> Tensor | None:
    """Return a mask of tokens (B, N), or of pairs (1, N, N) or (B, N, N), with an axis for the heads."""
    if mask is None:
        return None
    return (mask[:, None, None] if mask.dim() == 2 else mask[:, None]).bool()


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
