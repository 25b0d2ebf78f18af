"""Networks over the tokens of a window: transformers over time and over a frame's patches, and an LSTM.

Shape legend: B batch, T time, M tokens per time step, N frames, V views, P patches per view, E token, F features of a
frame.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import PolicyError
from lifelong.types import Depth, Layers, Share, Width


def sinusoidal_positions(length: int, dim: int, factor: float = 10.0) -> Tensor:
    """Return sine and cosine position codes, (length, dim) (Vaswani et al., 2017, section 3.5).

    Args:
        length: Number of positions.
        dim: Size of a code.
        factor: The paper's 10000; smaller here, because windows have ten steps, not a thousand words.
    """
    cpu = {"dtype": torch.float32, "device": "cpu"}  # on `meta` torch first imports 1.5 s of Python
    position = torch.arange(length, **cpu)[:, None]
    rate = torch.exp(torch.arange(0, dim, 2, **cpu) * (-math.log(factor) / dim))
    codes = torch.zeros(length, dim, **cpu)
    codes[:, 0::2] = torch.sin(position * rate)
    codes[:, 1::2] = torch.cos(position * rate)[:, : dim // 2]
    return codes.to(torch.get_default_device())


def block_causal_mask(length: int, tokens: int, device: torch.device | None = None) -> Tensor:
    """Return a mask (T M, T M) bool, True where a token attends: to its own time step and earlier ones."""
    step = torch.arange(length, device=device).repeat_interleave(tokens)
    return step[None, :] <= step[:, None]


def attend(qkv: Tensor, heads: int, mask: Tensor | None = None, dropout: float = 0.0) -> Tensor:
    """Return the attention of several heads, (B, S, heads * head_dim).

    Args:
        qkv: Queries, keys and values of all heads, (B, S, 3 * heads * head_dim).
        mask: Mask (S, S), True where a token attends; None: everywhere.
        dropout: Probability that an attention weight is dropped.
    """
    b, s, _ = qkv.shape
    q, k, v = qkv.view(b, s, 3, heads, -1).permute(2, 0, 3, 1, 4)  # each (B, heads, S, head_dim)
    mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=dropout)
    return mixed.transpose(1, 2).reshape(b, s, -1)


def drop_samples(x: Tensor, chance: float, training: bool) -> Tensor:
    """Return x (B, ...) with whole samples zeroed by chance and the others scaled up; in training only."""
    if not training or chance == 0.0:
        return x
    kept = x.new_empty(len(x), *(1,) * (x.dim() - 1)).bernoulli_(1.0 - chance)
    return x * kept.div_(max(1.0 - chance, torch.finfo(x.dtype).tiny))


class TransformerLayer(nn.Module):
    """Pre-norm self-attention and feed-forward network; unlike torch's layer it leaves the head size free.

    Args:
        dim: E.
        heads: Number of attention heads.
        head_dim: Size of a head.
        mlp_dim: Width of the feed-forward network.
        dropout: Dropout of attention weights, after attention and in the feed-forward network.
        attention_dropout: Dropout of attention weights alone; None: `dropout`. The original has none there.
        drop_path: Chance in training that a whole sample skips the feed-forward network, the others being scaled up
            (Huang et al., stochastic depth, ECCV 2016). The original has 0.1 there, and none around attention.
    """

    def __init__(
        self,
        dim: int,
        heads: int,
        head_dim: int,
        mlp_dim: int,
        dropout: float,
        attention_dropout: float | None = None,
        drop_path: float = 0.0,
    ) -> None:
        super().__init__()
        self.heads, self.head_dim, self.drop_path = heads, head_dim, drop_path
        self.dropout = dropout if attention_dropout is None else attention_dropout
        self.attention_norm, self.mlp_norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.qkv = nn.Linear(dim, 3 * heads * head_dim, bias=False)
        self.out = nn.Linear(heads * head_dim, dim)
        self.drop = nn.Dropout(dropout)
        self.mlp = nn.Sequential(
            nn.Linear(dim, mlp_dim),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(mlp_dim, dim),
            nn.Dropout(dropout),
        )

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """Map tokens (B, S, E) to the same shape; `mask` (S, S) is True where a token attends, None everywhere."""
        dropout = self.dropout if self.training else 0.0
        mixed = attend(self.qkv(self.attention_norm(x)), self.heads, mask, dropout)
        x = x + self.drop(self.out(mixed))
        return x + drop_samples(self.mlp(self.mlp_norm(x)), self.drop_path, self.training)


class TemporalTransformer(nn.Module):
    """Decoder-only transformer in which the tokens of a time step attend to each other and to everything before.

    The defaults are LIBERO's sizes.

    Args:
        dim: E.
        layers: Number of layers.
        heads: Number of attention heads.
        head_dim: Size of a head.
        mlp_dim: Width of the feed-forward networks.
        dropout: Dropout of attention weights, after attention and in the feed-forward networks.
        attention_dropout: Dropout of attention weights alone, see `TransformerLayer`.
        drop_path: Chance that a window skips a feed-forward network, see `TransformerLayer`.
        final_norm: Whether a LayerNorm follows the last layer, as is usual with pre-norm layers. The original has none.
        max_length: Longest window, T.
    """

    def __init__(
        self,
        *,
        dim: Width = 64,
        layers: Depth = 4,
        heads: Width = 6,
        head_dim: Width = 64,
        mlp_dim: Width = 256,
        dropout: Share = 0.1,
        attention_dropout: Share | None = None,
        drop_path: Share = 0.0,
        final_norm: bool = False,
        max_length: int = 10,
    ) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            TransformerLayer(dim, heads, head_dim, mlp_dim, dropout, attention_dropout, drop_path)
            for _ in range(layers)
        )
        self.norm = nn.LayerNorm(dim) if final_norm else nn.Identity()
        self.register_buffer("positions", sinusoidal_positions(max_length, dim), persistent=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map tokens (B, T, M, E) to the same shape; those of a time step carry that step's position code."""
        b, t, m, e = tokens.shape
        mask = block_causal_mask(t, m, tokens.device) if t > 1 else None
        x = (tokens + self.positions[:t, None]).reshape(b, t * m, e)
        for layer in self.layers:
            x = layer(x, mask)
        return self.norm(x).view(b, t, m, e)


class SpatialTransformer(nn.Module):
    """Transformer over the patches of a frame and its instruction: ViLT (Kim, Son and Kim, ICML 2021).

    The patches of all views and the instruction's token attend to each other; the output is read from a learned
    token. The defaults are LIBERO's sizes.

    Args:
        views: V.
        patches: P of every view.
        dim: E.
        out_dim: Size of the output.
        layers: Number of layers.
        heads: Number of attention heads.
        head_dim: Size of a head.
        mlp_dim: Width of the feed-forward networks.
        dropout: Dropout of attention weights, after attention and in the feed-forward networks.
        attention_dropout: Dropout of attention weights alone, see `TransformerLayer`.
        drop_path: Chance that a frame skips a feed-forward network, see `TransformerLayer`.
    """

    def __init__(
        self,
        *,
        views: int,
        patches: int,
        dim: Width = 128,
        out_dim: Width = 64,
        layers: Layers = 7,
        heads: Width = 8,
        head_dim: Width = 120,
        mlp_dim: Width = 256,
        dropout: Share = 0.1,
        attention_dropout: Share | None = None,
        drop_path: Share = 0.0,
    ) -> None:
        super().__init__()
        self.positions = nn.Parameter(torch.randn(views, patches, dim))
        self.modalities = nn.Parameter(torch.randn(views + 1, dim))  # each view, then language
        self.read = nn.Parameter(torch.randn(dim))
        self.layers = nn.ModuleList(
            TransformerLayer(dim, heads, head_dim, mlp_dim, dropout, attention_dropout, drop_path)
            for _ in range(layers)
        )
        self.project = nn.Linear(dim, out_dim)

    def forward(self, patches: Tensor, language: Tensor) -> Tensor:
        """Mix the patches of each frame with its instruction.

        Args:
            patches: Tokens of patches (N, V, P, E).
            language: Tokens of instructions (B, E); N = B T with the T frames of a window adjacent.

        Returns:
            One vector per frame (N, out_dim).
        """
        n = len(patches)
        seen = (patches + self.positions + self.modalities[:-1, None]).flatten(1, 2)
        instruction = (language + self.modalities[-1]).repeat_interleave(n // len(language), dim=0)
        x = torch.cat([self.read.expand(n, 1, -1), instruction[:, None], seen], dim=1)
        for layer in self.layers:
            x = layer(x)
        return self.project(x[:, 0])


class TemporalLSTM(nn.LSTM):
    """LSTM over windows, (B, T, F) -> (B, T, hidden).

    Args:
        in_dim: F.
        hidden: Size of the state.
        layers: Number of layers.
        dropout: Dropout between the layers.

    Raises:
        PolicyError: There is dropout between layers, and there is one layer.
    """

    def __init__(
        self,
        *,
        in_dim: int,
        hidden: Width = 1024,
        layers: Layers = 2,
        dropout: Share = 0.0,
    ) -> None:
        if dropout and layers == 1:
            raise PolicyError(
                f"policy.temporal.dropout={dropout} acts between layers, and there is one: use 0, or "
                "policy.temporal.layers=2"
            )
        super().__init__(in_dim, hidden, layers, dropout=dropout, batch_first=True)

    def forward(self, x: Tensor, state: tuple[Tensor, Tensor] | None = None) -> Any:
        """Return the outputs and the last state; with gradients in evaluation mode too, which cuDNN has not."""
        if self.training or not torch.is_grad_enabled():
            return super().forward(x, state)
        with torch.backends.cudnn.flags(enabled=False):
            return super().forward(x, state)
