"""Figures and a look become an `ObjectModel`."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from types import MappingProxyType

import mujoco
import numpy as np

from libero_env.mujoco_compat import set_damping
from libero_env.objects.builtin.facts import Facts, Part, load_facts
from libero_env.objects.builtin.mesh import Mesh
from libero_env.objects.model import GLOW_GROUP, ROOT_BODY, ObjectModel, rest_quat

HIDDEN_GROUP = 3
GLOWING_SITES = ("burner",)


@dataclass(frozen=True)
class Look:
    """What an object looks like: a mesh and the picture on it.

    Attributes:
        mesh: in the frame that `frame` names, metres: z up, front towards +x.
        image: texture, PNG bytes; the file's first row is v = 0.
        specular: strength of highlights, 0..1.
        shininess: sharpness of highlights, 0..1.
        alpha: 1 is opaque; glass is less.
        frame: `rest`: origin at the root, axes of the world when the object stands at rest; `body`: that of the body.
    """

    mesh: Mesh
    image: bytes
    specular: float = 0.25
    shininess: float = 0.4
    alpha: float = 1.0
    frame: str = "rest"


# Of the root body, or of several: body name (`main` is the root) -> its look, or several: a frame and its glass.
Looks = Look | Mapping[str, Look | tuple[Look, ...]]


def builders_of(looks: Mapping[str, Callable[[], Looks]]) -> Mapping[str, Callable[[], ObjectModel]]:
    """Makes object builders of look functions; each look is drawn once per process, when first asked for."""
    return MappingProxyType({name: partial(build, name, cache(look)) for name, look in looks.items()})


def build(category: str, look: Callable[[], Looks]) -> ObjectModel:
    """Builds one builtin object."""
    facts = load_facts(category)
    spec = mujoco.MjSpec()
    spec.modelname = category
    spec.compiler.degree = False
    bodies = {ROOT_BODY: spec.worldbody.add_body(name=ROOT_BODY)}
    for name, part in facts.parts.items():
        bodies[name] = bodies[part.parent].add_body(name=name, pos=part.pos, quat=part.quat)
    numbers = count()
    for name, part in {ROOT_BODY: facts.root, **facts.parts}.items():
        _add_mass(bodies[name], part)
        _add_joint(bodies[name], part)
        _add_collision(bodies[name], part, facts, numbers)
        _add_sites(bodies[name], part, name == ROOT_BODY)
    looks = look()
    turned = _conjugate(rest_quat(facts.rotation))
    for name, several in looks.items() if isinstance(looks, Mapping) else [(ROOT_BODY, looks)]:
        for index, one in enumerate(several if isinstance(several, tuple) else (several,)):
            mesh = one.mesh if one.frame == "body" else one.mesh.rotated(turned)
            _add_visual(spec, bodies[name], category, one, mesh, suffix=f"_{index}" if index else "")
    return ObjectModel(
        category=category,
        spec=spec,
        joint_damping=facts.joint_damping,
        rotation=facts.rotation,
        rotation_axis=facts.rotation_axis,
        bottom_offset=facts.bottom_offset,
        top_offset=facts.top_offset,
        horizontal_radius=facts.horizontal_radius,
        articulation=facts.articulation,
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


def _add_collision(body: mujoco.MjsBody, part: Part, facts: Facts, numbers: Iterator[int]) -> None:
    for solid in part.boxes:
        body.add_geom(
            name=f"g{next(numbers)}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{solid.type.upper()}"),
            pos=solid.pos,
            size=_padded(solid.size),
            quat=solid.quat,
            friction=solid.friction or facts.friction,
            condim=3,
            solref=solid.solref or facts.solref,
            solimp=(*(solid.solimp or facts.solimp), 0.5, 2.0),
            group=0,
            rgba=(0.8, 0.8, 0.8, 0.3),
        )


def _add_visual(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, category: str, look: Look, mesh: Mesh, *, suffix: str
) -> None:
    root = body.name == ROOT_BODY
    prefix = (category if root else f"{category}_{body.name}") + suffix
    # The category goes in front of each name: scenes share one namespace for textures and materials.
    # A file in `assets`, not a buffer: only so can a scene be written as XML.
    picture = f"{prefix}.png"
    spec.assets[picture] = look.image
    texture = spec.add_texture(name=f"{prefix}_texture", type=mujoco.mjtTexture.mjTEXTURE_2D, file=picture)
    material = spec.add_material(
        name=f"{prefix}_material",
        specular=look.specular,
        shininess=look.shininess,
        reflectance=0.0,
        rgba=(1.0, 1.0, 1.0, look.alpha),
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
