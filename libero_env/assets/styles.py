"""Floors and walls: named styles and the small textures that are generated for them."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import mujoco
import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.storage import read_yaml

_SIZE = 128  # [pixels] default side of a texture


@cache
def load_styles() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return kind (`floor`, `wall`, `scene`) -> name -> parameters."""
    return read_yaml("assets/workspaces/styles.yaml")


def styles_of(own: Mapping[str, str], scene_properties: Mapping[str, str]) -> dict[str, Mapping[str, Any]]:
    """Return the parameters of the styles of `floor` and `wall`.

    Args:
        own: Default styles, those of the workspace.
        scene_properties: Styles of the task file; they take precedence, after them that of their `scene`.

    Raises:
        UnknownNameError: A property or a style does not exist; the message lists the valid ones.
    """
    chosen = {key.removesuffix("_style"): name for key, name in scene_properties.items()}
    known = load_styles()
    for kind, name in chosen.items():
        if kind not in known:
            raise UnknownNameError("scene property", kind, known)
        if name not in known[kind]:
            raise UnknownNameError(f"{kind} style", name, known[kind])
    scene = known["scene"][chosen.pop("scene", "base")]
    styles = {**own, **scene, **chosen}
    return {kind: known[kind][styles[kind]] for kind in ("floor", "wall")}


def furniture_of(own: Sequence[str], scene_properties: Mapping[str, str]) -> tuple[str, ...]:
    """Return the names of the sets of furniture: those of the workspace, and those that the scene's style adds."""
    scene = scene_properties.get("scene", scene_properties.get("scene_style", "base"))
    return tuple(dict.fromkeys([*own, *load_styles()["scene"][scene].get("furniture", ())]))


def add_material(
    spec: mujoco.MjSpec, name: str, style: Mapping[str, Any], specular: float = 0.0, shininess: float = 0.0
) -> None:
    """Add a style to a scene as a material.

    The texture repeats each period; on meshes it follows the texture coordinates.
    """
    material = spec.add_material(name=name, specular=specular, shininess=shininess)
    if style["pattern"] == "plain":
        material.rgba = [*style["colours"][0], 1.0]
        return
    add_texture(spec, material, make_texture(style))
    material.texuniform, material.texrepeat = True, [1.0 / style["period"]] * 2


def add_texture(spec: mujoco.MjSpec, material: mujoco.MjsMaterial, image: np.ndarray) -> None:
    """Set the texture of a material to an image, (height, width, 3) uint8."""
    texture = spec.add_texture(
        name=material.name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        height=image.shape[0],
        width=image.shape[1],
        nchannel=3,
    )
    texture.data = image.tobytes()
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material.name


def make_texture(style: Mapping[str, Any]) -> np.ndarray:
    """Return one period of a style as a texture, (size, size, 3) uint8: the same at each call, and it tiles."""
    size, rng = style.get("size", _SIZE), np.random.default_rng(0)
    image = np.empty((size, size, 3))
    image[:] = style["colours"][0]
    image = _PATTERNS[style["pattern"]](image, style, rng)
    return np.clip(image * 255, 0, 255).astype(np.uint8)


def _tiles(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return square tiles with joints."""
    image[:1] = image[:, :1] = style["colours"][1]
    return image + rng.normal(0.0, style["grain"], (*image.shape[:2], 1))


def _planks(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return rows of boards with random tints and ends."""
    size, grain = len(image), style["grain"]
    image = image + _streaks(size, rng)[..., None] * grain
    edges = np.linspace(0, size, style["rows"] + 1).astype(int)
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        first, half = rng.integers(size), size // 2
        image[low:high] = np.roll(image[low:high], first, axis=1)
        image[low:high, :half] += rng.normal(0.0, grain)
        image[low:high, half:] += rng.normal(0.0, grain)
        image[low:high] = np.roll(image[low:high], rng.integers(size), axis=1)
        image[low, :] = style["colours"][1]
        image[low:high, rng.integers(size)] = style["colours"][1]
    return image


def _plaster(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return an uneven colour with some roughness."""
    size = len(image)
    rough = _smooth(size, (8, 8), rng) + 0.4 * _smooth(size, (2, 2), rng)
    return image + rough[..., None] * style["grain"]


def _linen(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return threads, more of them vertical."""
    size = len(image)
    threads = _smooth(size, (1, 24), rng) + 0.4 * _smooth(size, (24, 1), rng)
    return image + threads.T[..., None] * style["grain"]


def _marble(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return veins, which are where a smooth field crosses zero."""
    size = len(image)
    field = _smooth(size, (12, 12), rng) + 0.5 * _smooth(size, (4, 4), rng)
    vein = (
        np.exp(-((field / 0.18) ** 2))[..., None]
        * (0.5 + 0.5 * np.clip(_smooth(size, (16, 16), rng), 0, 1))[..., None]
    )
    return image * (1 - 0.5 * vein) + np.array(style["colours"][1]) * 0.5 * vein


def _wood(image: np.ndarray, style: Mapping[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Return one board whose grain runs along the second axis."""
    streaks = _streaks(len(image), rng)[..., None]
    return image + np.clip(streaks, -2, 2) * (np.array(style["colours"][0]) - style["colours"][1]) * 0.5


def _streaks(size: int, rng: np.random.Generator) -> np.ndarray:
    return 0.6 * _smooth(size, (4, 30), rng) + 0.6 * _smooth(size, (1.5, 16), rng)


def _smooth(size: int, widths: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return periodic noise (size, size), mean 0 and deviation 1, correlated over `widths` pixels down and across."""
    frequency = np.fft.fftfreq(size)
    decay = [np.exp(-2.0 * (np.pi * frequency * width) ** 2) for width in widths]
    noise = np.fft.fft2(rng.normal(size=(size, size))) * np.outer(*decay)
    field = np.fft.ifft2(noise).real
    return (field - field.mean()) / field.std()


_PATTERNS = {
    "tiles": _tiles,
    "planks": _planks,
    "plaster": _plaster,
    "linen": _linen,
    "marble": _marble,
    "wood": _wood,
}
