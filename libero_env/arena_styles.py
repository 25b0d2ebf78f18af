"""Floors and walls: named styles and the small pictures that are generated for them."""

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import mujoco
import numpy as np
import yaml

from libero_env.errors import UnknownNameError

_SIZE = 128  # pixels, side of a texture unless the style says otherwise


@cache
def load_styles() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """kind (`floor`, `wall`, `scene`) -> name -> figures."""
    return yaml.safe_load(resources.files("libero_env").joinpath("workspaces/styles.yaml").read_text())


def styles_of(own: Mapping[str, str], scene_properties: Mapping[str, str]) -> dict[str, Mapping[str, Any]]:
    """`floor` and `wall` -> figures of the style: that of the properties, else of their scene, else one's own.

    Raises:
        UnknownNameError: a property or a style that does not exist; the message lists the valid ones.
    """
    wanted = {key.removesuffix("_style"): name for key, name in scene_properties.items()}
    known = load_styles()
    for kind, name in wanted.items():
        if kind not in known:
            raise UnknownNameError("scene property", kind, known)
        if name not in known[kind]:
            raise UnknownNameError(f"{kind} style", name, known[kind])
    scene = known["scene"][wanted.pop("scene", "base")]
    return {kind: known[kind][name] for kind, name in {**own, **scene, **wanted}.items()}


def add_material(spec: mujoco.MjSpec, name: str, style: Mapping[str, Any]) -> None:
    """Add a style to a scene as a material."""
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    if style["pattern"] == "plain":
        material.rgba = [*style["colours"][0], 1.0]
        return
    image = picture(style)
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, height=image.shape[0], width=image.shape[1], nchannel=3,
    )  # fmt: skip
    texture.data = image.tobytes()
    material.texuniform, material.texrepeat = True, [1.0 / style["period"]] * 2
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def picture(style: Mapping[str, Any]) -> np.ndarray:
    """One period of a style, (size, size, 3) uint8; always the same."""
    size, rng = style.get("size", _SIZE), np.random.default_rng(0)
    image = np.empty((size, size, 3))
    image[:] = style["colours"][0]
    if style["pattern"] == "tiles":
        image[:1] = image[:, :1] = style["colours"][1]
    image += rng.normal(0.0, style.get("grain", 0.01), (size, size, 1))
    return np.clip(image * 255, 0, 255).astype(np.uint8)
