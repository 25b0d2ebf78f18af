"""How one simulation is drawn otherwise than its model says: cameras, lights, materials and colours.

An `Appearance` changes what is drawn and nothing else. The compiled model, which many simulations share, is never
written to: poses of cameras go to the kinematics that are drawn, the rest to the elements of MuJoCo's abstract scene.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import reduce
from typing import Any, TypeVar

import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.geometry import quat_to_mat
from libero_env.mujoco_compat import mujoco
from libero_env.sim.scene import Scene

HEADLIGHT = "headlight"  # name of the light at the camera, which models do not name
_COLOURS = ("ambient", "diffuse", "specular")  # of a light
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
Part = TypeVar("Part", "CameraView", "Light")


@dataclass(frozen=True)
class CameraView:
    """Where a camera is and what it sees. None keeps what the model has.

    Attributes:
        pos: Position in the world frame, [m].
        quat: Orientation in the world frame, wxyz; the camera looks along its -z, its y is up.
        fovy: Vertical field of view, [degrees].
    """

    pos: tuple[float, float, float] | None = None
    quat: tuple[float, float, float, float] | None = None
    fovy: float | None = None


@dataclass(frozen=True)
class Light:
    """A light. None keeps what the model has.

    Attributes:
        pos: Position in the world frame, [m].
        dir: Direction in the world frame, of length 1.
        ambient: Colour that it gives to everything, RGB.
        diffuse: Colour that it gives to what faces it, RGB.
        specular: Colour of its reflections, RGB.
    """

    pos: tuple[float, float, float] | None = None
    dir: tuple[float, float, float] | None = None
    ambient: tuple[float, float, float] | None = None
    diffuse: tuple[float, float, float] | None = None
    specular: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Appearance:
    """How one simulation is drawn otherwise than its model says.

    Attributes:
        cameras: Views by the camera's name in the model, such as `agentview`.
        lights: Lights by their name in the model; `headlight` is the one at the camera.
        materials: Name of a material in the model -> name of the material that is drawn instead.
        colours: Name of an object, a fixture or a material -> colour (RGB, 0 to 1) and share of its own colour that it
            replaces.
    """

    layer = "appearance"  # of a perturbation

    cameras: Mapping[str, CameraView] = field(default_factory=dict)
    lights: Mapping[str, Light] = field(default_factory=dict)
    materials: Mapping[str, str] = field(default_factory=dict)
    colours: Mapping[str, tuple[tuple[float, float, float], float]] = field(default_factory=dict)

    def __or__(self, other: "Appearance") -> "Appearance":
        """Return both looks at once; where both change the same, the other's counts."""
        return Appearance(
            cameras=_joined(self.cameras, other.cameras),
            lights=_joined(self.lights, other.lights),
            materials={**self.materials, **other.materials},
            colours={**self.colours, **other.colours},
        )


def joined(appearances: Iterable[Appearance]) -> Appearance:
    """Return several appearances as one; later ones take precedence."""
    return reduce(Appearance.__or__, appearances, Appearance())


def _joined(first: Mapping[str, Part], second: Mapping[str, Part]) -> dict[str, Part]:
    both = dict(first)
    for name, part in second.items():
        own = {f.name: getattr(part, f.name) for f in fields(part) if getattr(part, f.name) is not None}
        both[name] = replace(both[name], **own) if name in both else part
    return both


class SceneAppearance:
    """An appearance of one scene, with the indices of its model.

    Args:
        scene: Scene that is drawn.

    Raises:
        UnknownNameError: A camera, a light, a material or an object does not exist.
    """

    def __init__(self, appearance: Appearance, scene: Scene):
        model = scene.model
        self.appearance = appearance
        self._views = [
            (element_index(model, "camera", name), view, None if view.quat is None else _matrix(view.quat))
            for name, view in appearance.cameras.items()
        ]
        self._fovy = {index: view.fovy for index, view, _ in self._views if view.fovy is not None}
        self._lights = {
            -1 if name == HEADLIGHT else element_index(model, "light", name): light
            for name, light in appearance.lights.items()
        }
        self._active_lights = np.flatnonzero(model.light_active).tolist()
        self._materials = {
            element_index(model, "material", old): _material(model, element_index(model, "material", new))
            for old, new in appearance.materials.items()
        }
        self._colours: dict[int, tuple[np.ndarray, float]] = {}
        for name, (colour, share) in appearance.colours.items():
            own = np.asarray(colour, float), float(share)
            if name in scene.entities:
                geoms = np.flatnonzero(np.isin(model.geom_bodyid, scene.bodies[name]))
            else:
                geoms = np.flatnonzero(model.geom_matid == element_index(model, "material", name))
            self._colours |= dict.fromkeys(geoms.tolist(), own)

    def place_cameras(self, data: mujoco.MjData) -> None:
        """Write the poses of the cameras to kinematics that are drawn."""
        for index, view, mat in self._views:
            if view.pos is not None:
                data.cam_xpos[index] = view.pos
            if mat is not None:
                data.cam_xmat[index] = mat

    def fovy(self, camera: int) -> float | None:
        """Return the field of view of a camera, [degrees]; None where it is the model's."""
        return self._fovy.get(camera)

    def apply(self, drawn: mujoco.MjvScene, geoms: Sequence[mujoco.MjvGeom]) -> None:
        """Change the lights and geoms of an abstract scene.

        Args:
            drawn: Scene after `mjv_updateScene`.
            geoms: Its elements.
        """
        if self._lights:
            self._apply_lights(drawn)
        if not (self._materials or self._colours):
            return
        for geom in geoms:
            if geom.objtype != _GEOM:
                continue
            if (material := self._materials.get(geom.matid)) is not None:
                for name, value in material.items():
                    setattr(geom, name, value)
            if (colour := self._colours.get(geom.objid)) is not None:
                rgb, share = colour
                geom.rgba[:3] = (1.0 - share) * geom.rgba[:3] + share * rgb

    def apply_to_camera(self, drawn: mujoco.MjvScene, camera: int) -> float | None:
        """Set the field of view of the camera that an abstract scene is drawn from, and return it; see `fovy`."""
        if (fovy := self._fovy.get(camera)) is not None:
            for eye in drawn.camera:
                eye.frustum_top = eye.frustum_near * float(np.tan(np.deg2rad(fovy) / 2))
                eye.frustum_bottom = -eye.frustum_top
        return fovy

    def _apply_lights(self, drawn: mujoco.MjvScene) -> None:
        numbers = iter(self._active_lights)
        for light in drawn.lights[: drawn.nlight]:
            change = self._lights.get(-1 if light.headlight else next(numbers))
            if change is None:
                continue
            for name in _COLOURS if light.headlight else (*_COLOURS, "pos", "dir"):
                if (value := getattr(change, name)) is not None:
                    getattr(light, name)[:] = value


def element_index(model: mujoco.MjModel, what: str, name: str) -> int:
    """Return the index of a camera, a light or a material.

    Raises:
        UnknownNameError: The model has none of this name; the message lists those that it has.
    """
    kind = getattr(mujoco.mjtObj, f"mjOBJ_{what.upper()}")
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        count = {"camera": model.ncam, "light": model.nlight, "material": model.nmat}[what]
        names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(count)]
        raise UnknownNameError(what, name, [*filter(None, names), *([HEADLIGHT] if what == "light" else [])])
    return index


def _matrix(quat: Sequence[float]) -> np.ndarray:
    return quat_to_mat(np.asarray(quat, float) / np.linalg.norm(quat)).ravel()


def _material(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    """Return what elements of an abstract scene have of a material, by attribute."""
    names = ("emission", "specular", "shininess", "reflectance")
    found = {"matid": index, "rgba": model.mat_rgba[index]}
    found |= {name: float(getattr(model, f"mat_{name}")[index]) for name in names}
    if hasattr(mujoco.MjvGeom, "texid"):  # some versions of MuJoCo read these from the material
        found["texid"] = int(model.mat_texid[index, mujoco.mjtTextureRole.mjTEXROLE_RGB])
        found["texuniform"] = int(model.mat_texuniform[index])
        found["texrepeat"] = model.mat_texrepeat[index]
    return found
