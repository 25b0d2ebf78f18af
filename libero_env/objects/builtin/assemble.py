"""Build an `ObjectModel` from the physics of a category and the appearance that a function makes."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from types import MappingProxyType

import mujoco
import numpy as np

from libero_env.mujoco_compat import set_damping
from libero_env.objects.builtin.mesh import Mesh
from libero_env.objects.builtin.physics import Part, Physics, load_physics
from libero_env.objects.model import GLOW_GROUP, ROOT_BODY, ObjectModel, rest_quat

HIDDEN_GROUP = 3
GLOWING_SITES = ("burner",)


@dataclass(frozen=True)
class Appearance:
    """Visual of a body: a mesh and its texture.

    Attributes:
        mesh: Triangles in the frame that `frame` names, [m]: z up, front towards +x.
        image: Texture as PNG bytes; the first row of the file is v = 0.
        specular: Strength of highlights, in [0, 1].
        shininess: Sharpness of highlights, in [0, 1].
        alpha: Opacity, in [0, 1]; 1 is opaque.
        frame: `rest` (origin at the root, axes of the world when the object is at rest) or `body` (frame of the body).
    """

    mesh: Mesh
    image: bytes
    specular: float = 0.25
    shininess: float = 0.4
    alpha: float = 1.0
    frame: str = "rest"


# Appearance of the root body, or body name (`main` is the root) -> one or several, such as a window's frame and glass.
Appearances = Appearance | Mapping[str, Appearance | tuple[Appearance, ...]]
AppearanceFunction = Callable[[], Appearances]


def builders_of(functions: Mapping[str, AppearanceFunction]) -> Mapping[str, Callable[[], ObjectModel]]:
    """Return a builder for each category; an appearance is drawn once per process, on its first use.

    Args:
        functions: Category -> function that makes its appearance.
    """
    return MappingProxyType(
        {category: partial(build, category, cache(function)) for category, function in functions.items()}
    )


def build(category: str, make_appearance: AppearanceFunction) -> ObjectModel:
    """Build the model of a builtin category.

    Args:
        category: Name of the category in `parameters/`.
        make_appearance: Returns what the bodies look like.
    """
    physics = load_physics(category)
    spec = mujoco.MjSpec()
    spec.modelname = category
    spec.compiler.degree = False
    bodies = {ROOT_BODY: spec.worldbody.add_body(name=ROOT_BODY)}
    for name, part in physics.parts.items():
        bodies[name] = bodies[part.parent].add_body(name=name, pos=part.pos, quat=part.quat)
    numbers = count()
    for name, part in {ROOT_BODY: physics.root, **physics.parts}.items():
        _add_mass(bodies[name], part)
        _add_joint(bodies[name], part)
        _add_collision(bodies[name], part, physics, numbers)
        _add_sites(bodies[name], part, name == ROOT_BODY)
    appearances = make_appearance()
    turned = _conjugate(rest_quat(physics.rotation))
    for name, several in (
        appearances.items() if isinstance(appearances, Mapping) else [(ROOT_BODY, appearances)]
    ):
        for index, one in enumerate(several if isinstance(several, tuple) else (several,)):
            mesh = one.mesh if one.frame == "body" else one.mesh.rotated(turned)
            _add_visual(spec, bodies[name], category, one, mesh, suffix=f"_{index}" if index else "")
    return ObjectModel(
        category=category,
        spec=spec,
        joint_damping=physics.joint_damping,
        rotation=physics.rotation,
        rotation_axis=physics.rotation_axis,
        bottom_offset=physics.bottom_offset,
        top_offset=physics.top_offset,
        horizontal_radius=physics.horizontal_radius,
        articulation=physics.articulation,
    )


def _add_mass(body: mujoco.MjsBody, part: Part) -> None:
    body.explicitinertial = True
    body.mass, body.ipos = part.mass, part.com
    if part.mass:
        body.fullinertia = part.inertia
    else:
        body.inertia = (0.0, 0.0, 0.0)


def _add_joint(body: mujoco.MjsBody, part: Part) -> None:
    if part.joint is None:
        return
    kind = getattr(mujoco.mjtJoint, f"mjJNT_{part.joint.type.upper()}")
    joint = body.add_joint(
        name=part.joint.name, type=kind, axis=part.joint.axis, pos=part.joint.pos, range=part.joint.range
    )
    set_damping(joint, part.joint.damping)


def _add_collision(body: mujoco.MjsBody, part: Part, physics: Physics, numbers: Iterator[int]) -> None:
    for shape in part.boxes:
        body.add_geom(
            name=f"g{next(numbers)}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.type.upper()}"),
            pos=shape.pos,
            size=_padded(shape.size),
            quat=shape.quat,
            friction=shape.friction or physics.friction,
            condim=3,
            solref=shape.solref or physics.solref,
            solimp=(*(shape.solimp or physics.solimp), 0.5, 2.0),
            group=0,
            rgba=(0.8, 0.8, 0.8, 0.3),
        )


def _add_visual(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    category: str,
    appearance: Appearance,
    mesh: Mesh,
    *,
    suffix: str,
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
        reflectance=0.0,
        rgba=(1.0, 1.0, 1.0, appearance.alpha),
    )
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    material.textures = textures
    spec.add_mesh(
        name=f"{prefix}_mesh",
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        usertexcoord=mesh.texcoords.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        name=("visual" if root else f"{body.name}_visual") + suffix,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=f"{prefix}_mesh",
        material=material.name,
        contype=0,
        conaffinity=0,
        group=1,
        mass=0.0,
    )


def _add_sites(body: mujoco.MjsBody, part: Part, root: bool) -> None:
    hidden = {"rgba": (0.0, 0.0, 0.0, 0.0), "group": HIDDEN_GROUP}
    glowing = {"rgba": (0.9, 0.05, 0.05, 1.0), "group": GLOW_GROUP}
    if root:
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        body.add_site(name="default_site", type=sphere, pos=(0.0, 0.0, 0.0), size=(0.002,) * 3, **hidden)
    for site in part.sites:
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{site.type.upper()}")
        style = glowing if site.name in GLOWING_SITES else hidden
        body.add_site(
            name=site.name, type=kind, pos=site.pos, size=_padded(site.size), quat=site.quat, **style
        )


def _padded(size: tuple[float, ...]) -> tuple[float, ...]:
    return (*size, 0.0, 0.0, 0.0)[:3]


def _conjugate(quat: np.ndarray) -> np.ndarray:
    return quat * (1.0, -1.0, -1.0, -1.0)
