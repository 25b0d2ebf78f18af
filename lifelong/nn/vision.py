"""Image encoders: a ResNet of basic blocks, each modulated by the instruction, read out as keypoints; and patches.

Shape legend: N images, C channels, H W image, K keypoints, P patches, L language embedding, E latent or token.
"""

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import PolicyError
from lifelong.types import Positive, Width

Norm = Literal["group", "batch", "none"]  # see `make_norm`
Side = Annotated[int, Field(ge=1, le=1000)]  # [pixels or cells] of a kernel, a stride or a patch
Pixels = Literal["centred", "libero"]  # see `to_network`
Init = Literal["identity", "libero"]  # see `ResNetFiLMEncoder`


def to_network(images: Tensor, pixels: str) -> Tensor:
    """Return images as the first convolution takes them.

    Args:
        images: Images (N, H, W, 3) uint8, upright.
        pixels: `centred`: upright and in [-1, 1]; `libero`: bottom row first and in [0, 1], as the original's
            networks see what its simulator renders.

    Returns:
        Images (N, 3, H, W) float32, with channels last in memory.
    """
    if pixels == "libero":
        return images.flip(1).movedim(-1, 1).to(torch.float32).div_(255.0)
    assert pixels == "centred", pixels
    return images.movedim(-1, 1).to(torch.float32).mul_(2.0 / 255.0).sub_(1.0)


def make_norm(kind: str, channels: int) -> nn.Module:
    """Build the normalisation after a convolution.

    Args:
        kind: Kind of normalisation: `group` (8 channels a group; no state, so it neither depends on the batch nor
            drifts from task to task), `batch` (the original's; keeps running statistics) or `none`.
        channels: C.

    Raises:
        PolicyError: The channels cannot be divided into groups.
    """
    if kind == "group":
        groups = max(1, channels // 8)
        if channels % groups:
            raise PolicyError(
                f"{channels} channels cannot be normalised in groups of 8; use a multiple of 8, or another norm"
            )
        return _GroupNorm(groups, channels)
    return {"batch": nn.BatchNorm2d, "none": nn.Identity}[kind](channels)


class _GroupNorm(nn.GroupNorm):
    """Group normalisation that can be learned on inputs that need no gradient, such as those of a frozen convolution.

    There PyTorch (2.13, on a CPU, channels last) writes the gradient of the input into no memory and is killed.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (N, C, H, W)."""
        learned = any(p.requires_grad for p in self.parameters())
        if learned and torch.is_grad_enabled() and not x.requires_grad:
            x = x.detach().requires_grad_()
        return super().forward(x)


class FiLM(nn.Module):
    """Feature-wise linear modulation: h <- (1 + gamma(language)) h + beta(language).

    Perez et al., FiLM (AAAI 2018), eq. 1-2.

    Args:
        language_dim: L.
        channels: C.
        identity: Whether it starts as the identity, so that an untrained instruction changes nothing; otherwise it
            starts as any linear layer, as in the original.
    """

    def __init__(self, *, language_dim: int, channels: int, identity: bool = True) -> None:
        super().__init__()
        self.project = nn.Linear(language_dim, 2 * channels)
        if identity:
            nn.init.zeros_(self.project.weight)
            nn.init.zeros_(self.project.bias)

    def forward(self, h: Tensor, language: Tensor) -> Tensor:
        """Modulate `h` (N, C, H, W) by `language` (M, L); N is a multiple of M, frames of a window adjacent."""
        gamma, beta = self.project(language).to(h.dtype).chunk(2, dim=-1)
        n, c, height, width = h.shape
        frames = n // language.shape[0]
        windows = h.view(-1, frames, c, height, width)
        scale, shift = (1 + gamma)[:, None, :, None, None], beta[:, None, :, None, None]
        return (windows * scale + shift).view(n, c, height, width)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al., CVPR 2016, fig. 2 and option B)."""

    def __init__(self, *, in_channels: int, channels: int, stride: int = 1, norm: str = "group") -> None:
        super().__init__()
        bias = norm == "none"
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=bias)
        self.norm1 = make_norm(norm, channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=bias)
        self.norm2 = make_norm(norm, channels)
        self.shortcut = nn.Identity()
        if stride != 1 or in_channels != channels:
            conv = nn.Conv2d(in_channels, channels, 1, stride=stride, bias=bias)
            self.shortcut = nn.Sequential(conv, make_norm(norm, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Map features (N, C_in, H, W) to (N, C, H / stride, W / stride)."""
        h = functional.relu(self.norm1(self.conv1(x)), inplace=True)
        h = self.norm2(self.conv2(h))
        return functional.relu(h + self.shortcut(x), inplace=True)


class SpatialSoftmax(nn.Module):
    """Expected position in the image under each of K learned heat maps.

    Finn et al., Deep spatial autoencoders (ICRA 2016). Computed in float32: bfloat16 positions would be
    coarser than a pixel.

    Args:
        channels: C.
        size: H, W of the feature map.
        keypoints: K.
        temperature: Divisor of the heat. At 1 (the original) an untrained layer averages over the whole map, so that
            its positions hardly depend on the image and learning starts slowly; at 0.1 they move fifteen times as
            much.
    """

    def __init__(
        self, *, channels: int, size: tuple[int, int], keypoints: int, temperature: float = 1.0
    ) -> None:
        super().__init__()
        self.temperature = temperature
        self.heat = nn.Linear(channels, keypoints)
        rows, cols = (torch.linspace(-1.0, 1.0, n, device="cpu") for n in size)  # see sinusoidal_positions
        grid = torch.stack(torch.meshgrid(cols, rows, indexing="xy"), dim=-1)  # (H, W, 2): x, y
        grid = grid.reshape(-1, 2).T.contiguous().to(torch.get_default_device())
        self.register_buffer("grid", grid, persistent=False)

    def forward(self, h: Tensor) -> Tensor:
        """Return positions x, y in [-1, 1], (N, C, H, W) -> (N, 2 K), x rightwards and y downwards."""
        heat = self.heat(h.permute(0, 2, 3, 1)).flatten(1, 2)  # (N, H W, K), as it lies in memory
        with torch.autocast(h.device.type, enabled=False):
            positions = self.grid @ (heat.float() / self.temperature).softmax(dim=1)  # (N, 2, K)
        return positions.transpose(1, 2).flatten(1)


class FlatReadout(nn.Module):
    """The whole feature map, reduced to a few channels and read by one linear layer.

    An object's position is a linear function of where its features are. In a short training this localises better
    than keypoints (experiments/laptop); it has more weights, and they fit one image size only.

    Args:
        channels: C.
        size: H, W of the feature map.
        features: K, the size of the output.
        reduced: Number of channels that the linear layer reads.
    """

    def __init__(self, *, channels: int, size: tuple[int, int], features: int, reduced: int = 8) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, reduced, 1)
        self.read = nn.Linear(reduced * size[0] * size[1], features)
        self.norm = nn.LayerNorm(features)  # keeps the features alive from task to task

    def forward(self, h: Tensor) -> Tensor:
        """Map features (N, C, H, W) to (N, K)."""
        return functional.gelu(self.norm(self.read(self.reduce(h).flatten(1))))


class ResNetFiLMEncoder(nn.Module):
    """Image encoder of ResNet-T: ResNet-18's first stages, FiLM after every block, keypoints, one linear map.

    The defaults are LIBERO's (Liu et al., NeurIPS 2023, appendix A): stem and first two stages of ResNet-18,
    64-d latent from 32 keypoints. Every size is an argument, so that a small one runs on a laptop.

    Args:
        image_size: H, W in pixels.
        language_dim: L.
        latent_dim: E.
        width: Channels of the stem and the first stage; each further stage doubles them.
        stage_blocks: Number of basic blocks per stage; every stage but the first halves the resolution.
        stem_kernel: Side of the first convolution's kernel.
        stem_stride: Stride of the first convolution.
        stem_pool: Whether a 3x3 max pool of stride 2 follows the first convolution.
        keypoints: K, the number of keypoints; None takes E / 2.
        temperature: Temperature of the keypoints' softmax, see `SpatialSoftmax`.
        readout: How the feature map is read: `keypoints` (K of them), or `flat` with 2 K features.
        norm: Normalisation after convolutions: `group`, `batch` or `none`, see `make_norm`.
        stem_film: Whether the instruction modulates the stem's features too, as it does those of every block. Without
            blocks it is the only place where it can.
        pixels: Form in which images enter: `centred` or `libero`, see `to_network`.
        init: Initial weights. `identity`: FiLM starts as the identity, convolutions as PyTorch's do. `libero`: FiLM
            starts as any linear layer, convolutions of stem and blocks by He et al. (ICCV 2015, fan out), as
            torchvision's ResNet.

    Raises:
        PolicyError: The image is too small for the number of stages.
    """

    def __init__(
        self,
        *,
        image_size: tuple[int, int],
        language_dim: int,
        latent_dim: Width = 64,
        width: Width = 64,
        stage_blocks: Annotated[Sequence[Annotated[int, Field(ge=0, le=100)]], Field(max_length=8)] = (2, 2),
        stem_kernel: Side = 7,
        stem_stride: Side = 2,
        stem_pool: bool = True,
        keypoints: Width | None = None,
        temperature: Positive = 1.0,
        readout: Literal["keypoints", "flat"] = "keypoints",
        norm: Norm = "group",
        stem_film: bool = False,
        pixels: Pixels = "centred",
        init: Init = "identity",
    ) -> None:
        super().__init__()
        self.pixels = pixels
        stem = [
            nn.Conv2d(3, width, stem_kernel, stem_stride, padding=stem_kernel // 2, bias=norm == "none"),
            make_norm(norm, width),
            nn.ReLU(inplace=True),
        ]
        self.stem = nn.Sequential(*stem, *([nn.MaxPool2d(3, 2, padding=1)] if stem_pool else []))
        film = partial(FiLM, language_dim=language_dim, identity=init == "identity")
        self.stem_film = film(channels=width) if stem_film else None
        self.blocks, self.films = nn.ModuleList(), nn.ModuleList()
        channels = width
        for stage, count in enumerate(stage_blocks):
            for index in range(count):
                out, stride = width * 2**stage, 2 if stage > 0 and index == 0 else 1
                self.blocks.append(BasicBlock(in_channels=channels, channels=out, stride=stride, norm=norm))
                self.films.append(film(channels=out))
                channels = out
        for layer in self.modules() if init == "libero" else ():
            if isinstance(layer, nn.Conv2d):  # of stem and blocks: the rest is not built yet
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
        size = self._map_size(image_size)
        keypoints = keypoints or max(1, latent_dim // 2)
        if readout == "flat":
            self.readout: nn.Module = FlatReadout(channels=channels, size=size, features=2 * keypoints)
        else:
            assert readout == "keypoints", readout
            self.readout = SpatialSoftmax(
                channels=channels, size=size, keypoints=keypoints, temperature=temperature
            )
        self.project = nn.Linear(2 * keypoints, latent_dim)
        self.to(memory_format=torch.channels_last)

    def _map_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Return height and width of the feature map that the readout reads."""
        conv, pools = self.stem[0], sum(isinstance(m, nn.MaxPool2d) for m in self.stem)
        size = []
        for n in image_size:
            n = (n + 2 * conv.padding[0] - conv.kernel_size[0]) // conv.stride[0] + 1
            halvings = pools + sum(block.conv1.stride[0] == 2 for block in self.blocks)
            for _ in range(halvings):
                n = (n - 1) // 2 + 1
            size.append(n)
        if min(size) < 4:
            raise PolicyError(
                f"images of {image_size} leave a feature map of {tuple(size)}, too small to localise anything; "
                "use larger images, fewer stages, a smaller stem_stride, or stem_pool=false"
            )
        return size[0], size[1]

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Encode images.

        Args:
            images: Images (N, H, W, 3) uint8.
            language: Embeddings (M, L); N = M T with the T frames of a window adjacent.

        Returns:
            Latents (N, E).
        """
        h = self.stem(to_network(images, self.pixels))
        if self.stem_film is not None:
            h = self.stem_film(h, language)
        for block, film in zip(self.blocks, self.films, strict=True):
            h = film(block(h), language)
        return self.project(self.readout(h))


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
        PolicyError: The patches do not tile the image.
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


def encode_views(encoders: nn.ModuleDict, images: Tensor, language: Tensor) -> list[Tensor]:
    """Return the latents of each view, (B, T, E), in order.

    Args:
        encoders: Image encoder of each view.
        images: Images (B, T, V, H, W, 3) uint8.
        language: Embeddings (B, L).
    """
    return [
        encoder(images[:, :, view].flatten(0, 1), language).view(*images.shape[:2], -1)
        for view, encoder in enumerate(encoders.values())
    ]
