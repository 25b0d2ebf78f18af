"""Figures and a look become an `ObjectModel`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from types import MappingProxyType

import mujoco
import numpy as np

from libero_env.objects.builtin.facts import Facts, load_facts
from libero_env.objects.builtin.mesh import Mesh
from libero_env.objects.model import ROOT_BODY, ObjectModel, rest_quat

# Contacts as stiff as the timestep allows (refsafe); the original's objects use the same numbers.
SOLREF = (0.001, 1.0)
SOLIMP = (0.998, 0.998, 0.001, 0.5, 2.0)
HIDDEN_GROUP = 3


@dataclass(frozen=True)
class Look:
    """What an object looks like: a mesh and the picture on it.

    Attributes:
        mesh: in the rest frame: origin at the root, z up, front towards +x.
        image: texture, PNG bytes; the file's first row is v = 0.
        specular: strength of highlights, 0..1.
        shininess: sharpness of highlights, 0..1.
    """

    mesh: Mesh
    image: bytes
    specular: float = 0.25
    shininess: float = 0.4


def builders_of(looks: Mapping[str, Callable[[], Look]]) -> Mapping[str, Callable[[], ObjectModel]]:
    """Makes object builders of look functions; each look is drawn once per process, when first asked for."""
    return MappingProxyType({name: partial(build, name, cache(look)) for name, look in looks.items()})


def build(category: str, look: Callable[[], Look]) -> ObjectModel:
    """Builds one builtin object."""
    facts = load_facts(category)
    spec = mujoco.MjSpec()
    spec.modelname = category
    body = spec.worldbody.add_body(name=ROOT_BODY)
    body.explicitinertial = True
    body.mass, body.ipos, body.fullinertia = facts.mass, facts.com, facts.inertia
    _add_collision(body, facts)
    _add_visual(spec, body, category, look(), facts)
    _add_sites(body, facts)
    return ObjectModel(
        category=category,
        spec=spec,
        joint_damping=facts.joint_damping,
        rotation=MappingProxyType(facts.rotation),
        rotation_axis=facts.rotation_axis,
        bottom_offset=facts.bottom_offset,
        top_offset=facts.top_offset,
        horizontal_radius=facts.horizontal_radius,
    )


def _add_collision(body: mujoco.MjsBody, facts: Facts) -> None:
    for index, box in enumerate(facts.boxes):
        body.add_geom(
            name=f"g{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.pos,
            size=box.size,
            quat=box.quat,
            friction=facts.friction,
            condim=4,
            solref=SOLREF,
            solimp=SOLIMP,
            group=0,
            rgba=(0.8, 0.8, 0.8, 0.3),
        )


def _add_visual(spec: mujoco.MjSpec, body: mujoco.MjsBody, category: str, look: Look, facts: Facts) -> None:
    # The category goes in front of each name: scenes share one namespace for textures and materials.
    # A file in `assets`, not a buffer: only so can a scene be written as XML.
    picture = f"{category}.png"
    spec.assets[picture] = look.image
    texture = spec.add_texture(name=f"{category}_texture", type=mujoco.mjtTexture.mjTEXTURE_2D, file=picture)
    material = spec.add_material(
        name=f"{category}_material", specular=look.specular, shininess=look.shininess, reflectance=0.0
    )
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    material.textures = textures
    mesh = look.mesh.rotated(_conjugate(rest_quat(facts.rotation)))
    spec.add_mesh(
        name=f"{category}_mesh",
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        usertexcoord=mesh.texcoords.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        name="visual",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=f"{category}_mesh",
        material=material.name,
        contype=0,
        conaffinity=0,
        group=1,
        mass=0.0,
    )


def _add_sites(body: mujoco.MjsBody, facts: Facts) -> None:
    hidden = {"rgba": (0.0, 0.0, 0.0, 0.0), "group": HIDDEN_GROUP}
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_site(name="default_site", type=sphere, pos=(0.0, 0.0, 0.0), size=(0.002,) * 3, **hidden)
    for site in facts.sites:
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{site.type.upper()}")
        body.add_site(name=site.name, type=kind, pos=site.pos, size=site.size, quat=site.quat, **hidden)


def _conjugate(quat: np.ndarray) -> np.ndarray:
    return quat * (1.0, -1.0, -1.0, -1.0)
