"""The models of the builtin objects, from their physics (`parameters/`) and their appearance (`appearance/`)."""

from collections.abc import Mapping
from itertools import count
from typing import Any

from libero_env.mujoco_compat import mujoco, set_damping
from libero_env.objects.builtin.appearance import Appearance, appearance_of
from libero_env.objects.builtin.physics import categories, load_physics
from libero_env.objects.model import GLOW_GROUP, ROOT_BODY, VISUAL_GEOM, ObjectModel, add_visual

HIDDEN_GROUP = 3
GLOWING_SITES = ("burner",)
TARGET_ZONE = "target_zone"
_SOLID: Mapping[str, Any] = {"group": 0, "condim": 3, "rgba": (0.8, 0.8, 0.8, 0.3)}
_HIDDEN: Mapping[str, Any] = {"group": HIDDEN_GROUP, "rgba": (0.0, 0.0, 0.0, 0.0)}
_GLOWING: Mapping[str, Any] = {"group": GLOW_GROUP, "rgba": (0.9, 0.05, 0.05, 1.0)}


def builtin_names() -> frozenset[str]:
    """Return the categories of the builtin pack."""
    return frozenset((*categories(), TARGET_ZONE))


def build(category: str) -> ObjectModel:
    """Return a new model of a builtin category at each call.

    Raises:
        KeyError: No builtin object has this name.
    """
    if category == TARGET_ZONE:
        return _target_zone()
    physics = load_physics(category)
    spec = mujoco.MjSpec()
    spec.modelname = category
    spec.compiler.degree = False
    bodies: dict[str, mujoco.MjsBody] = {}
    numbers = count()
    for name, part in physics.bodies.items():
        parent = bodies[part["parent"]] if "parent" in part else spec.worldbody
        body = bodies[name] = parent.add_body(
            name=name, pos=part.get("pos", (0.0, 0.0, 0.0)), quat=part.get("quat", (1.0, 0.0, 0.0, 0.0))
        )
        body.explicitinertial = True
        body.mass, body.ipos = part.get("mass", 0.0), part.get("com", (0.0, 0.0, 0.0))
        if body.mass:
            body.fullinertia = part["inertia"]
        else:
            body.inertia = (0.0, 0.0, 0.0)
        if "joint" in part:
            joint = dict(part["joint"])
            damping, kind = joint.pop("damping", 0.0), f"mjJNT_{joint.pop('type').upper()}"
            set_damping(body.add_joint(type=getattr(mujoco.mjtJoint, kind), **joint), damping)
        for box in part.get("boxes", ()):
            options = {**_SOLID, **physics.contact, **_shape(box)}
            body.add_geom(name=f"g{next(numbers)}", **options)
        if name == ROOT_BODY:
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE
            body.add_site(name="default_site", type=sphere, size=(0.002,) * 3, **_HIDDEN)
        for site in part.get("sites", ()):
            body.add_site(**_shape(site), **(_GLOWING if site["name"] in GLOWING_SITES else _HIDDEN))
    for name, several in appearance_of(category).items():
        for index, appearance in enumerate(several):
            _add_visual(spec, bodies[name], category, appearance, suffix=f"_{index}" if index else "")
    return ObjectModel(category, spec, **physics.of_model)


def _shape(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a shape as MuJoCo takes them: a box unless it has a type, a size of three numbers."""
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{keys.get('type', 'box').upper()}")
    return {**keys, "type": kind, "size": (*keys["size"], 0.0, 0.0)[:3]}


def _add_visual(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, category: str, appearance: Appearance, *, suffix: str
) -> None:
    root = body.name == ROOT_BODY
    prefix = (category if root else f"{category}_{body.name}") + suffix
    # The category is a prefix of each name: scenes share one namespace for textures and materials.
    # A file in `assets`, not a buffer: MuJoCo cannot write buffers as XML.
    image_file = f"{prefix}.png"
    spec.assets[image_file] = appearance.image
    texture = spec.add_texture(name=f"{prefix}_texture", type=mujoco.mjtTexture.mjTEXTURE_2D, file=image_file)
    material = spec.add_material(
        name=f"{prefix}_material",
        specular=appearance.specular,
        shininess=appearance.shininess,
        rgba=(1.0, 1.0, 1.0, appearance.alpha),
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    mesh = appearance.mesh.add_to(spec, f"{prefix}_mesh")
    name = "visual" if root else f"{body.name}_visual"
    add_visual(body, f"{name}{suffix}", mesh, material=material.name)


def _target_zone() -> ObjectModel:
    """Return a flat translucent rectangle that marks a place; its site `default_site` is slightly above it."""
    spec, box, half = mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_BOX, (0.05, 0.05, 0.001)
    spec.modelname = TARGET_ZONE
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name=ROOT_BODY, explicitinertial=True, mass=0.0, inertia=(0.0, 0.0, 0.0))
    body.add_geom(name="visual", type=box, size=half, rgba=(0.85, 0.15, 0.15, 0.5), **VISUAL_GEOM)
    body.add_site(name="default_site", type=box, size=(*half[:2], 0.007), **_HIDDEN)
    return ObjectModel(category=TARGET_ZONE, spec=spec, horizontal_radius=half[0])
