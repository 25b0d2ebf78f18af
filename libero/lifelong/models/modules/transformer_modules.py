"""Parts of transformers.

Shape legend: B batch, T time, M tokens per time step, N tokens, E token.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.nn.transformer import TransformerLayer, block_causal_mask, sinusoidal_positions

__all__ = [
    "Attention",
    "DropPath",
    "Norm",
    "SinusoidalPositionEncoding",
    "TransformerDecoder",
    "TransformerFeedForwardNN",
]


class SinusoidalPositionEncoding(nn.Module):
    """Sine and cosine codes of time steps (Vaswani et al., 2017, section 3.5).

    Args:
        input_size: E.
        inv_freq_factor: stands where the paper has 10000.
        factor_ratio: the codes are multiplied by it; None: by 1.
    """

    def __init__(self, input_size: int, inv_freq_factor: float = 10, factor_ratio: float | None = None):
        super().__init__()
        self.input_size, self.inv_freq_factor, self.factor_ratio = input_size, inv_freq_factor, factor_ratio

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, ...) -> (T, E), the codes of its time steps."""
        codes = sinusoidal_positions(x.shape[1], self.input_size, self.inv_freq_factor).to(x.device)
        return codes if self.factor_ratio is None else codes * self.factor_ratio

    def output_shape(self, input_shape: tuple[int, ...]) -> tuple[int, ...]:
        """The shape that it is given."""
        return input_shape


class Norm(nn.Module):
    """Layer normalisation."""

    def __init__(self, size: int):
        super().__init__()
        self.norm = nn.LayerNorm(size)

    def forward(self, x: Tensor) -> Tensor:
        """(..., E) -> (..., E)."""
        return self.norm(x)


class Attention(nn.Module):
    """Self-attention whose heads have a size of their own.

    Args:
        dim: E.
        num_heads, head_output_size: heads and the size of each.
        dropout: of the weights and of the output.
    """

    def __init__(self, dim: int, num_heads: int = 8, head_output_size: int = 64, dropout: float = 0.0):
        super().__init__()
        self.num_heads, self.head_output_size, self.dropout = num_heads, head_output_size, dropout
        self.qkv = nn.Linear(dim, 3 * num_heads * head_output_size, bias=False)
        self.output_layer = nn.Sequential(nn.Linear(num_heads * head_output_size, dim), nn.Dropout(dropout))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, N, E), mask (N, N) true where a token may look -> (B, N, E)."""
        qkv = self.qkv(x).unflatten(-1, (3, self.num_heads, self.head_output_size))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        allowed = None if mask is None else mask.bool()
        dropout = self.dropout if self.training else 0.0
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=allowed, dropout_p=dropout)
        return self.output_layer(mixed.transpose(1, 2).flatten(2))


class TransformerFeedForwardNN(nn.Module):
    """The layers between two attentions."""

    def __init__(self, dim: int, hidden_dim: int, dropout: float = 0.0):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(dim, hidden_dim),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden_dim, dim),
            nn.Dropout(dropout),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(..., E) -> (..., E)."""
        return self.net(x)


class DropPath(nn.Module):
    """In training, a branch of a residual network is left out for some rows (Huang et al., ECCV 2016).

    Args:
        drop_prob: chance for a row; what stays is scaled so that the mean is as before.
    """

    def __init__(self, drop_prob: float | None = None):
        super().__init__()
        self.drop_prob = drop_prob or 0.0

    def forward(self, x: Tensor) -> Tensor:
        """(B, ...) -> (B, ...)."""
        if not self.training or self.drop_prob == 0.0:
            return x
        rows = torch.rand(len(x), *[1] * (x.dim() - 1), device=x.device) >= self.drop_prob
        return x * rows / (1 - self.drop_prob)


class TransformerDecoder(nn.Module):
    """Layers of pre-norm attention and feed-forward, each `lifelong.nn.transformer.TransformerLayer`.

    Args:
        input_size: E.
        num_layers, num_heads, head_output_size, mlp_hidden_size, dropout: sizes.
    """

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
        self.layers = nn.ModuleList(
            TransformerLayer(
                dim=input_size,
                heads=num_heads,
                head_dim=head_output_size,
                mlp_dim=mlp_hidden_size,
                dropout=dropout,
            )
            for _ in range(num_layers)
        )
        self.mask: Tensor | None = None

    def compute_mask(self, input_shape: tuple[int, ...]) -> None:
        """From now on tokens see their own time step and earlier ones; input_shape is (B, T, M, E)."""
        self.mask = block_causal_mask(input_shape[1], input_shape[2])

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, N, E) -> (B, N, E), with this mask, else that of `compute_mask`, else without one."""
        mask = self.mask if mask is None else mask
        for layer in self.layers:
            x = layer(x, None if mask is None else mask.to(x.device).bool())
        return x
