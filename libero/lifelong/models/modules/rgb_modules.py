"""Image encoders: the networks of `lifelong.nn`, for images (N, C, H, W) in [0, 1].

Shape legend: N images, C H W image, L language embedding, E latent.
"""

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from libero._adapters.batches import uint8_image
from lifelong.errors import PolicyError
from lifelong.nn import vision


class ResnetEncoder(nn.Module):
    """First stages of ResNet-18 with FiLM, read out as keypoints; see `lifelong.nn.vision.ResNetFiLMEncoder`.

    Of ResNet-18's ten layers `remove_layer_num` are removed at the end: 2 leaves four stages, 5 one. `no_stride`: the
    stem keeps the resolution. `freeze`: the encoder is not trained. `language_fusion` is `film` or `none`.
    `pretrained` must be false. `more` are other arguments of the network, such as `norm="batch"`.

    Raises:
        PolicyError: Invalid values, or an image too small for the number of stages.
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
        sizes: dict[str, Any] = {"image_size": tuple(input_shape)[1:], "latent_dim": output_size}
        sizes |= {"language_dim": language_dim, **resnet_arguments(remove_layer_num, no_stride)}
        self.encoder = vision.ResNetFiLMEncoder(**{**sizes, **more})
        configure_resnet(self.encoder, pretrained, freeze, language_fusion)

    def forward(self, x: Tensor, langs: Tensor | None = None) -> Tensor:
        """Encode images (N, C, H, W) as (N, E), given embeddings (M, L) with N a multiple of M, or zeros."""
        langs = x.new_zeros(1, self.language_dim) if langs is None else langs
        return self.encoder(uint8_image(x), langs.float())

    def output_shape(self, input_shape: Sequence[int] = (), shape_meta: Any = None) -> tuple[int, ...]:
        """Return the shape of one latent, (E,)."""
        return (self.output_size,)


class PatchEncoder(nn.Module):
    """Strided convolution and one linear map for each patch of its output; see `lifelong.nn.vision.PatchEncoder`.

    `patch_size` has two equal sides, in cells of the convolution's output. `more` are other arguments of the network.
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
        sizes = {"image_size": (height, width), "dim": embed_size, "patch": square(patch_size)}
        self.encoder = vision.PatchEncoder(**{**sizes, **more})
        self.patch_size, self.num_patches, self._aspect = patch_size, self.encoder.patches, width / height

    def forward(self, x: Tensor) -> Tensor:
        """Encode images (N, C, H, W) as (N, E, rows, columns)."""
        rows = round((self.num_patches / self._aspect) ** 0.5)
        return self.encoder(uint8_image(x)).transpose(1, 2).unflatten(2, (rows, -1))


class _NoLanguage(nn.Module):
    """Stands in for FiLM where the instruction is not used."""

    def forward(self, h: Tensor, language: Tensor) -> Tensor:
        return h


def resnet_arguments(remove_layer_num: int = 2, no_stride: bool = False, **_: object) -> dict[str, Any]:
    """Return the native encoder's arguments for the original's; see `ResnetEncoder`."""
    if not 2 <= remove_layer_num <= 5:
        raise PolicyError(f"remove_layer_num is {remove_layer_num}; valid: 2 (four stages) to 5 (one stage)")
    stem = {"stem_stride": 1, "stem_pool": False} if no_stride else {}
    return {"stage_blocks": (2,) * (6 - remove_layer_num), **stem}


def configure_resnet(
    encoder: Any, pretrained: bool = False, freeze: bool = False, language_fusion: str = "film", **_: object
) -> None:
    """Apply the original's arguments that change a built encoder; see `ResnetEncoder`."""
    if pretrained:
        raise PolicyError("no pretrained ResNet comes with this package: set pretrained to false")
    if language_fusion not in ("film", "none"):
        raise PolicyError(f"language_fusion is {language_fusion!r}; valid: film, none")
    if language_fusion == "none":
        encoder.films = nn.ModuleList(_NoLanguage() for _ in encoder.films)
    if freeze:
        encoder.requires_grad_(False)


def square(patch_size: Sequence[int]) -> int:
    """Return the side of a patch; raise a PolicyError if its sides differ."""
    if len(set(patch_size)) != 1:
        raise PolicyError(f"patch_size is {list(patch_size)}; patches are squares, such as [8, 8]")
    return int(patch_size[0])
