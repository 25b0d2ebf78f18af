"""Kinds that change how a scene is rendered: the agent's camera, the lights, surfaces, colours of objects."""

import colorsys
from weakref import WeakKeyDictionary

import numpy as np

from libero_env.assets.arena import SPARE, surface_styles
from libero_env.errors import InvalidInputError
from libero_env.geometry import mat_to_quat, quat_to_mat, rotation_about
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations.kinds import direction, sign
from libero_env.sim.appearance import HEADLIGHT, Appearance, CameraView, Light
from libero_env.sim.scene import Scene

CAMERA = "agentview"  # the camera that does not move with the robot
_DISTANCE = 1.2  # factor of the distance, or its inverse, at the full angle
_FULL_ANGLE = 30.0  # [degrees]
_LIGHT_ANGLE = 60.0  # [degrees] by which lights turn at the full ratio
_FULL_RATIO = 3.0


def orbit(scene: Scene, axis_angle: float, degrees: float, factor: float) -> CameraView:
    """Return the view of the agent's camera moved about the point of the workspace that it looks at, and upright.

    Args:
        axis_angle: Direction of the movement in the image: 0 moves the camera to its right, pi / 2 upwards, [rad].
        degrees: Angle between the rays from the point to the camera before and after.
        factor: Ratio of the distances from the point after and before.
    """
    model = scene.model
    index = model.camera(CAMERA).id
    pos, mat = model.cam_pos[index], quat_to_mat(model.cam_quat[index])
    pivot = pivot_of(scene)
    across = -np.sin(axis_angle) * mat[:, 0] + np.cos(axis_angle) * mat[:, 1]  # axis of the movement
    moved = pivot + factor * rotation_about(across, np.deg2rad(degrees)) @ (pos - pivot)
    backward = (moved - pivot) / np.linalg.norm(moved - pivot)
    right = np.cross((0.0, 0.0, 1.0), backward)
    right /= np.linalg.norm(right)
    turned = mat_to_quat(np.stack([right, np.cross(backward, right), backward], axis=1))
    w, *axis = turned.tolist()
    return CameraView(tuple(moved.tolist()), (w, axis[0], axis[1], axis[2]))


def pivot_of(scene: Scene) -> np.ndarray:
    """Return the point (3,) where the axis of the agent's camera meets the surface that objects stand on, [m]."""
    model = scene.model
    index = model.camera(CAMERA).id
    forward = -quat_to_mat(model.cam_quat[index])[:, 2]
    reach = (scene.workspace.surface_height - model.cam_pos[index][2]) / forward[2]
    return model.cam_pos[index] + reach * forward


def _camera(degrees: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    towards, factor = rng.uniform(0, 2 * np.pi), _DISTANCE ** (sign(rng) * degrees / _FULL_ANGLE)
    return Appearance(cameras={CAMERA: orbit(scene, towards, degrees, factor)})


def _fov(degrees: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    fovy = float(scene.model.cam_fovy[scene.model.camera(CAMERA).id]) + sign(rng) * degrees
    return Appearance(cameras={CAMERA: CameraView(fovy=fovy)})


def _light(ratio: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    model, factor = scene.model, ratio ** sign(rng)
    share = np.log(ratio) / np.log(_FULL_RATIO)
    axis = direction(rng, 3) * (1.0, 1.0, 0.0)
    turn = rotation_about(axis / np.linalg.norm(axis), np.deg2rad(_LIGHT_ANGLE * share))
    head = model.vis.headlight
    lights = {HEADLIGHT: _scaled(head.ambient, head.diffuse, head.specular, factor)}
    for i in range(model.nlight):
        light = _scaled(model.light_ambient[i], model.light_diffuse[i], model.light_specular[i], factor)
        turned = tuple((turn @ model.light_dir[i]).tolist())
        lights[model.light(i).name] = Light(None, turned, light.ambient, light.diffuse, light.specular)
    return Appearance(lights=lights)


def _scaled(ambient: np.ndarray, diffuse: np.ndarray, specular: np.ndarray, factor: float) -> Light:
    colours = [tuple((factor * np.asarray(c, float)).tolist()) for c in (ambient, diffuse, specular)]
    return Light(ambient=colours[0], diffuse=colours[1], specular=colours[2])


_TABLES = ("table_texture", "living_room_table", "desk", "short_coffee_table")
# Names of the materials of surfaces: the builtin models', then the original's.
_MATERIALS = {
    "floor": ("floor", "room_floorplane"),
    "wall": ("wall", "room_walls_mat"),
    "table": ("table", *(f"room_{name}" for name in _TABLES)),
}
_FURNITURE = ("furniture_colours", "room_living_room", "room_kitchen_background", "room_office_book_shelf")
_SAME = 0.02  # RGB distance below which a style is the surface's own
_LIKE = 0.08  # styles whose distances differ by less are sampled from
_COLOUR_WORDS = ("black", "white", "red", "yellow")


def _table(distance: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    on_floor = not scene.workspace.parameters.get("table")
    return Appearance(materials=_other_style(scene, "floor" if on_floor else "table", distance, rng))


def _background(distance: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    on_floor = not scene.workspace.parameters.get("table")
    kinds = ("wall",) if on_floor else ("wall", "floor")
    styles = [_other_style(scene, kind, distance, rng) for kind in kinds]
    tint = colorsys.hsv_to_rgb(rng.uniform(), 0.8, 0.9), min(1.0, distance)
    names = {scene.model.material(i).name for i in range(scene.model.nmat)}
    furniture = dict.fromkeys(names & set(_FURNITURE), tint)
    return Appearance(materials={k: v for style in styles for k, v in style.items()}, colours=furniture)


def _other_style(scene: Scene, kind: str, distance: float, rng: np.random.Generator) -> dict[str, str]:
    """Return the material of a surface -> one whose mean colour is about as far from its own, in RGB."""
    colours = _mean_colours(scene.model)
    if not (own := [name for name in _MATERIALS[kind] if name in colours]):
        raise InvalidInputError(
            f"{scene.workspace_name} has no material {kind} of this package that another could replace; leave the "
            "perturbations table and background out"
        )
    spare = [SPARE + name for name in surface_styles()]
    away = {name: float(np.linalg.norm(colours[name] - colours[own[0]])) for name in spare}
    away = {name: far for name, far in away.items() if far > _SAME}
    nearest = min(abs(far - distance) for far in away.values())
    chosen = [name for name, far in away.items() if abs(far - distance) <= nearest + _LIKE * min(1, distance)]
    return {own[0]: chosen[rng.integers(len(chosen))]}


_colours: "WeakKeyDictionary[mujoco.MjModel, dict[str, np.ndarray]]" = WeakKeyDictionary()


def _mean_colours(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the mean colour of each material, RGB from 0 to 1."""
    if model not in _colours:
        _colours[model] = {model.material(i).name: mean_colour(model, i) for i in range(model.nmat)}
    return _colours[model]


def mean_colour(model: mujoco.MjModel, material: int) -> np.ndarray:
    """Return the mean colour of a material, RGB from 0 to 1, (3,)."""
    texture = int(np.max(model.mat_texid[material]))
    if texture < 0:
        return model.mat_rgba[material, :3]
    start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
    size = model.tex_height[texture] * model.tex_width[texture] * channels
    pixels = model.tex_data[start : start + size].reshape(-1, channels)
    return pixels[:, :3].mean(axis=0) / 255 * model.mat_rgba[material, :3]


def _colour(share: float, rng: np.random.Generator, scene: Scene) -> Appearance:
    said = {word for word in _COLOUR_WORDS if word in scene.problem.language.lower().split()}
    colours = {}
    for name, category in scene.problem.objects.items():
        colour = colorsys.hsv_to_rgb(rng.uniform(), 0.8, 0.9)
        if not said & set(category.split("_")):  # what the instruction calls black stays so
            colours[name] = (colour, share)
    return Appearance(colours=colours)


SAMPLERS = {
    "camera": _camera,
    "fov": _fov,
    "light": _light,
    "table": _table,
    "background": _background,
    "colour": _colour,
}
