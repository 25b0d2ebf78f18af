"""What rooms look like: named styles of floors and walls with their generated textures, and the furniture.

The pieces of furniture that a file lists become one mesh and one small palette texture: a whole room is one geom, which
costs one draw call.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.builtin.mesh import Mesh, Ring, box, loft, merge, quad
from libero_env.objects.model import add_visual
from libero_env.storage import read_yaml

_SIZE = 128  # [pixels] default side of a texture
_CELLS = 8  # colours along a side of the palette
_CELL_PIXELS = 8  # side of a colour's square
_COVERS = ("red", "navy", "teal", "cream", "yellow", "black", "orange", "white", "walnut")  # colours of books


def load_styles() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return kind (`floor`, `wall`, `scene`) -> name -> parameters."""
    return read_yaml("assets/workspaces/styles.yaml")


def chosen_styles(defaults: Mapping[str, str], scene_properties: Mapping[str, str]) -> dict[str, str]:
    """Return the names of the styles of `floor`, `wall` and the whole `scene`.

    Args:
        defaults: Styles of the workspace.
        scene_properties: Styles of the task file; they take precedence, after them that of their `scene`.

    Raises:
        UnknownNameError: A property or a style does not exist; the message lists the valid ones.
        InvalidInputError: Two properties are of one kind, such as `floor` and `floor_style`.
    """
    chosen = {key.removesuffix("_style"): name for key, name in scene_properties.items()}
    if len(chosen) < len(scene_properties):
        names = ", ".join(scene_properties)
        raise InvalidInputError(f"scene properties {names}: two are of one kind; expected each once")
    valid = load_styles()
    for kind, name in chosen.items():
        if kind not in valid:
            raise UnknownNameError("scene property", kind, valid)
        if name not in valid[kind]:
            raise UnknownNameError(f"{kind} style", name, valid[kind])
    scene = chosen.setdefault("scene", "base")
    return {**defaults, **valid["scene"][scene], **chosen}


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
    flat, (height, width) = mujoco.mjtTexture.mjTEXTURE_2D, image.shape[:2]
    texture = spec.add_texture(name=material.name, type=flat, height=height, width=width, nchannel=3)
    texture.data = image.tobytes()
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material.name


def make_texture(style: Mapping[str, Any]) -> np.ndarray:
    """Return one period of a style as a texture, (size, size, 3) uint8: the same at each call, and it tiles."""
    size, rng = style.get("size", _SIZE), np.random.default_rng(0)
    image = np.empty((size, size, 3))
    image[:] = style["colours"][0]
    return _as_pixels(_PATTERNS[style["pattern"]](image, style, rng))


def _as_pixels(image: np.ndarray) -> np.ndarray:
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
    pattern.__name__.removeprefix("_"): pattern
    for pattern in (_tiles, _planks, _plaster, _linen, _marble, _wood)
}


def add_visual_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: Mesh, material: str | None = None
) -> None:
    """Add a mesh to a body as a geom without collisions.

    Args:
        spec: Scene to extend.
        body: Body that carries the geom.
        mesh: Mesh in the frame of the body, [m].
        material: Name of its material; None adds one with the furniture's palette.
    """
    if material is None:
        material = f"{name}_colours"
        added = spec.add_material(name=material, specular=0.1, shininess=0.1)
        cells, colours = np.zeros((_CELLS * _CELLS, 3)), list(_read_furniture()["palette"].values())
        cells[: len(colours)] = colours
        palette = cells.reshape(_CELLS, _CELLS, 3).repeat(_CELL_PIXELS, 0).repeat(_CELL_PIXELS, 1)
        add_texture(spec, added, _as_pixels(palette))
    add_visual(body, name, mesh.add_to(spec, name), material=material)


@cache
def furniture(sets: tuple[str, ...]) -> Mesh:
    """Return all pieces of the given sets as one mesh in the world frame."""
    return merge([shape for name in sets for piece in _read_furniture()[name] for shape in _shapes(piece)])


def _shapes(piece: Mapping[str, Any]) -> Iterator[Mesh]:
    if "books" in piece:
        shapes = _books(piece["books"], piece["count"])
    elif "leaves" in piece:
        shapes = _leaves(piece)
    else:
        shapes = [_painted(solid_mesh(piece), piece["in"])]
    times, *step = piece.get("repeat", [1, 0.0, 0.0, 0.0])
    for i in range(times):
        yield from (shape.moved(np.multiply(step, i)) for shape in shapes)


def solid_mesh(piece: Mapping[str, Any]) -> Mesh:
    """Return the mesh of a `box` between two corners, or of a `round`: a stack of ellipses or rounded rectangles."""
    if "box" in piece:
        low, high = np.array(piece["box"][:3]), np.array(piece["box"][3:])
        return box((high - low) / 2, (high + low) / 2, (0.0, 0.0, 1.0, 1.0))
    corner = piece.get("corner", 2.0)
    rings = [Ring(z, rx, ry, z, corner, crease=True) for z, rx, ry in piece["round"]]
    return loft(rings, piece.get("sides", 16), tuple(piece["at"]))


def _books(bounds: Sequence[float], count: int) -> list[Mesh]:
    """Return a row of books along y with heights and thicknesses that vary, the same at each call."""
    x0, y0, z0, x1, y1, z1 = bounds
    rng = np.random.default_rng(count)
    widths = rng.uniform(0.6, 1.4, count)
    edges = y0 + (y1 - y0) * np.concatenate([[0.0], np.cumsum(widths) / widths.sum()])
    tops = z0 + (z1 - z0) * rng.uniform(0.75, 1.0, count)
    fronts = x1 - rng.uniform(0.0, 0.03, count)
    return [
        _painted(
            solid_mesh({"box": (x0, left, z0, front, right - 0.004, top)}), _COVERS[i * 4 % len(_COVERS)]
        )
        for i, (left, right, top, front) in enumerate(zip(edges[:-1], edges[1:], tops, fronts, strict=True))
    ]


def _leaves(piece: Mapping[str, Any]) -> list[Mesh]:
    """Return blades that rise and bend outwards, visible from both sides, the same at each call."""
    at, rng = np.array(piece["at"]), np.random.default_rng(piece["leaves"])
    blades = []
    for i in range(piece["leaves"]):
        angle = 2.4 * i  # golden angle
        out = np.array([np.cos(angle), np.sin(angle), 0.0]) * piece["reach"] * rng.uniform(0.6, 1.0)
        up = np.array([0.0, 0.0, piece["rise"]]) * rng.uniform(0.5, 1.0)
        side = np.array([-np.sin(angle), np.cos(angle), 0.0]) * 0.025
        root, middle, tip = at, at + 0.5 * out + 0.8 * up, at + out + 0.7 * up
        for low, high in ((root, middle), (middle, tip)):
            wide, narrow = (0.5, 1.0) if low is root else (1.0, 0.1)
            corners = [low - wide * side, low + wide * side, high + narrow * side, high - narrow * side]
            blades += [quad(order, _cell(piece["in"]) * 2) for order in (corners, corners[::-1])]
    return blades


def _painted(mesh: Mesh, colour: str) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces, np.tile(_cell(colour), (len(mesh.vertices), 1)))


def _cell(colour: str) -> tuple[float, float]:
    """Return (u, v) of the centre of a colour's square."""
    row, column = divmod(list(_read_furniture()["palette"]).index(colour), _CELLS)
    return (column + 0.5) / _CELLS, (row + 0.5) / _CELLS


def _read_furniture() -> Mapping[str, Any]:
    return read_yaml("assets/workspaces/furniture.yaml")
