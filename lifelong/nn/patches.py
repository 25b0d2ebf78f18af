"""Image patches, and a transformer that mixes them with the instruction to one token per frame.

Shape legend: N frames, M windows, V views, P patches per view, H W image, E token.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import PolicyError
from lifelong.nn.transformer import TransformerLayer
from lifelong.nn.vision import Norm, Pixels, Side, make_norm, to_network
from lifelong.types import Depth, Share, Width


class PatchEncoder(nn.Module):
    """Tokens of an image's patches: a strided convolution, then one linear map per patch of its output.

    Args:
        image_size: H, W in pixels.
        dim: E.
        width: Channels of the convolution.
        stem_kernel: Side of the convolution's kernel.
        stem_stride: Stride of the convolution.
        patch: Side of a patch, in cells of the convolution's output.
        norm: Normalisation, see `make_norm`.
        pixels: Form in which images enter: `centred` or `libero`, see `to_network`.
        rectify: Whether a ReLU follows the last normalisation; the original has none there.

    Raises:
        PolicyError: An unknown norm, or an image that patches do not tile.
    """

    def __init__(
        self,
        *,
        image_size: tuple[int, int],
        dim: Width = 128,
        width: Width = 64,
        stem_kernel: Side = 7,
        stem_stride: Side = 2,
        patch: Side = 8,
        norm: Norm = "group",
        pixels: Pixels = "centred",
        rectify: bool = True,
    ) -> None:
        super().__init__()
        self.pixels, self.rectify = pixels, rectify
        padding = stem_kernel // 2
        cells = [(n + 2 * padding - stem_kernel) // stem_stride + 1 for n in image_size]
        if any(n < patch or n % patch for n in cells):
            raise PolicyError(
                f"images of {tuple(image_size)} give {cells[0]} x {cells[1]} cells after the stem, which patches "
                f"of {patch} x {patch} do not tile; change policy.encoder.patch or policy.encoder.stem_stride"
            )
        self.patches = (cells[0] // patch) * (cells[1] // patch)
        self.stem = nn.Sequential(
            nn.Conv2d(3, width, stem_kernel, stem_stride, padding=padding, bias=norm == "none"),
            make_norm(norm, width),
            nn.ReLU(inplace=True),
        )
        self.project = nn.Conv2d(width, dim, patch, patch)
        self.norm = make_norm(norm, dim)
        self.to(memory_format=torch.channels_last)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images (N, H, W, 3) uint8 to tokens (N, P, E), row by row."""
        h = self.norm(self.project(self.stem(to_network(images, self.pixels))))
        if self.rectify:
            h = functional.relu(h, inplace=True)
        return h.flatten(2).transpose(1, 2)


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
        layers: Depth = 7,
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
            TransformerLayer(
                dim=dim,
                heads=heads,
                head_dim=head_dim,
                mlp_dim=mlp_dim,
                dropout=dropout,
                attention_dropout=attention_dropout,
                drop_path=drop_path,
            )
            for _ in range(layers)
        )
        self.project = nn.Linear(dim, out_dim)

    def forward(self, patches: Tensor, language: Tensor) -> Tensor:
        """Mix the patches of each frame with its instruction.

        Args:
            patches: Tokens of patches (N, V, P, E).
            language: Tokens of instructions (M, E); N = M T with the T frames of a window adjacent.

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
