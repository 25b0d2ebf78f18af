"""Image encoders under the original's names: the networks are those of `lifelong.nn`.

Shape legend: N images, C H W image, K keypoints, L language embedding, E latent.
"""

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from libero._adapters.lifelong.observations import uint8_image
from lifelong.errors import PolicyError
from lifelong.nn import patches, vision

__all__ = ["PatchEncoder", "ResnetEncoder", "SpatialProjection", "SpatialSoftmax"]


class SpatialSoftmax(nn.Module):
    """Expected image position of each heat map, (N, C, H, W) -> (N, 2 K).

    Args:
        in_c, in_h, in_w: C, H, W.
        num_kp: K, learned maps; None takes each channel as one.
    """

    def __init__(self, in_c: int, in_h: int, in_w: int, num_kp: int | None = None):
        super().__init__()
        self.num_kp = num_kp or in_c
        self.softmax = vision.SpatialSoftmax(channels=in_c, size=(in_h, in_w), keypoints=self.num_kp)
        if num_kp is None:
            self.softmax.heat = nn.Identity()  # type: ignore[assignment]

    def forward(self, x: Tensor) -> Tensor:
        """Positions in [-1, 1], x rightwards and y downwards."""
        return self.softmax(x)


class SpatialProjection(nn.Module):
    """Keypoints and one linear map, (N, C, H, W) -> (N, out_dim); out_dim is even."""

    def __init__(self, input_shape: Sequence[int], out_dim: int):
        super().__init__()
        if out_dim % 2:
            raise PolicyError(f"out_dim is {out_dim}; it must be even: two numbers for each keypoint")
        self.out_dim = out_dim
        self.spatial_softmax = SpatialSoftmax(input_shape[0], input_shape[1], input_shape[2], out_dim // 2)
        self.projection = nn.Linear(out_dim, out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, out_dim)."""
        return self.projection(self.spatial_softmax(x))

    def output_shape(self, input_shape: Sequence[int]) -> tuple[int, ...]:
        """(N, ...) -> (N, out_dim)."""
        return (*input_shape[:-3], self.out_dim)


class ResnetEncoder(nn.Module):
    """The first stages of ResNet-18 with FiLM, read out as keypoints; see `lifelong.nn.vision.ResNetFiLMEncoder`.

    Args:
        input_shape: C, H, W.
        output_size: E.
        pretrained: refused: no weights come with this package.
        freeze: nothing in it learns.
        remove_layer_num: of ResNet-18's ten layers, so many are left out at the end: 2 leaves four stages, 5 one.
        no_stride: the stem keeps the resolution.
        language_dim: L.
        language_fusion: `film` or `none`.
        more: other arguments of the network, such as `norm="batch"`.

    Raises:
        PolicyError: values that cannot work, or an image too small for the number of stages.
    """

    def __init__(
        self,
        input_shape: Sequence[int],
        output_size: int = 64,
        pretrained: bool = False,
        freeze: bool = False,
        remove_layer_num: int = 2,
        no_stride: bool = False,
        language_dim: int = 768,
        language_fusion: str = "film",
        **more: Any,
    ):
        super().__init__()
        self.language_dim, self.output_size = language_dim, output_size
        sizes = {**resnet_sizes(remove_layer_num, no_stride), **more}
        self.encoder = vision.ResNetFiLMEncoder(
            image_size=tuple(input_shape)[1:],  # type: ignore[arg-type]
            language_dim=language_dim,
            latent_dim=output_size,
            **sizes,
        )
        fuse(self.encoder, pretrained=pretrained, freeze=freeze, language_fusion=language_fusion)

    def forward(self, x: Tensor, langs: Tensor | None = None) -> Tensor:
        """Encodes pictures.

        Args:
            x: (N, C, H, W) in [0, 1].
            langs: (M, L), N a multiple of M; None: zeros.

        Returns:
            (N, E).
        """
        langs = x.new_zeros(1, self.language_dim) if langs is None else langs
        return self.encoder(uint8_image(x), langs.float())

    def output_shape(self, input_shape: Sequence[int] = (), shape_meta: Any = None) -> tuple[int, ...]:
        """(E,)."""
        return (self.output_size,)


class PatchEncoder(nn.Module):
    """A strided convolution and one linear map per patch of it, (N, C, H, W) -> (N, E, rows, columns).

    Args:
        input_shape: C, H, W.
        patch_size: sides of a patch, equal, in cells of the convolution's output.
        embed_size: E.
        more: other arguments of `lifelong.nn.patches.PatchEncoder`.

    Raises:
        PolicyError: patches that do not tile the picture.
    """

    def __init__(
        self,
        input_shape: Sequence[int],
        patch_size: Sequence[int] = (16, 16),
        embed_size: int = 64,
        **more: Any,
    ):
        super().__init__()
        _, height, width = input_shape
        self.patch_size = patch_size
        self.encoder = patches.PatchEncoder(
            image_size=(height, width), dim=embed_size, patch=square(patch_size), **more
        )
        self.num_patches = self.encoder.patches
        self._aspect = width / height

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) in [0, 1] -> (N, E, rows, columns)."""
        rows = round((self.num_patches / self._aspect) ** 0.5)
        return self.encoder(uint8_image(x)).transpose(1, 2).unflatten(2, (rows, -1))


class _WithoutLanguage(nn.Module):
    """Stands for FiLM where the instruction has no say."""

    def forward(self, h: Tensor, language: Tensor) -> Tensor:
        return h


def resnet_sizes(remove_layer_num: int, no_stride: bool) -> dict[str, Any]:
    """The native encoder's sizes for the original's way to name them.

    Raises:
        PolicyError: more or fewer layers than can be left out.
    """
    if not 2 <= remove_layer_num <= 5:
        raise PolicyError(f"remove_layer_num is {remove_layer_num}; valid: 2 (four stages) to 5 (one stage)")
    stem = {"stem_stride": 1, "stem_pool": False} if no_stride else {}
    return {"stage_blocks": (2,) * (6 - remove_layer_num), **stem}


def fuse(encoder: vision.ResNetFiLMEncoder, *, pretrained: bool, freeze: bool, language_fusion: str) -> None:
    """What the original's arguments change of an encoder.

    Raises:
        PolicyError: weights that there are not, or an unknown way to bring the instruction in.
    """
    if pretrained:
        raise PolicyError("no pretrained ResNet comes with this package: set pretrained to false")
    if language_fusion not in ("film", "none"):
        raise PolicyError(f"language_fusion is {language_fusion!r}; valid: film, none")
    if language_fusion == "none":
        encoder.films = nn.ModuleList(_WithoutLanguage() for _ in encoder.films)
    if freeze:
        encoder.requires_grad_(False)


def square(patch_size: Sequence[int]) -> int:
    """The side of a patch.

    Raises:
        PolicyError: its sides differ.
    """
    if len(set(patch_size)) != 1:
        raise PolicyError(f"patch_size is {list(patch_size)}; patches are squares, such as [8, 8]")
    return int(patch_size[0])
