"""The models of the builtin objects, from their physics (`parameters/`) and their appearance (`appearance/`)."""

from collections.abc import Iterator
from itertools import count

from libero_env.mujoco_compat import mujoco, set_damping
from libero_env.objects.builtin.appearance import Appearance, appearance_of
from libero_env.objects.builtin.physics import Part, Physics, categories, load_physics
from libero_env.objects.model import GLOW_GROUP, ROOT_BODY, VISUAL_GEOM, ObjectModel

HIDDEN_GROUP = 3
GLOWING_SITES = ("burner",)
TARGET_ZONE = "target_zone"


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
    bodies = {ROOT_BODY: spec.worldbody.add_body(name=ROOT_BODY)}
    for name, part in physics.parts.items():
        bodies[name] = bodies[part.parent].add_body(name=name, pos=part.pos, quat=part.quat)
    numbers = count()
    for name, part in {ROOT_BODY: physics.root, **physics.parts}.items():
        _add_mass(bodies[name], part)
        _add_joint(bodies[name], part)
        _add_collision(bodies[name], part, physics, numbers)
        _add_sites(bodies[name], part, name == ROOT_BODY)
    for name, several in appearance_of(category).items():
        for index, appearance in enumerate(several):
            _add_visual(spec, bodies[name], category, appearance, suffix=f"_{index}" if index else "")
    return ObjectModel(category, spec, **physics.of_model)


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
    spec: mujoco.MjSpec, body: mujoco.MjsBody, category: str, appearance: Appearance, *, suffix: str
) -> None:
    root, mesh = body.name == ROOT_BODY, appearance.mesh
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
        **VISUAL_GEOM,
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


def _target_zone() -> ObjectModel:
    """Return a flat translucent rectangle that marks a place; its site `default_site` is slightly above it."""
    spec, box, half = mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_BOX, (0.05, 0.05, 0.001)
    spec.modelname = TARGET_ZONE
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name=ROOT_BODY, explicitinertial=True, mass=0.0, inertia=(0.0, 0.0, 0.0))
    color, clear = (0.85, 0.15, 0.15, 0.5), (0.0, 0.0, 0.0, 0.0)
    body.add_geom(name="visual", type=box, size=half, rgba=color, **VISUAL_GEOM)
    body.add_site(name="default_site", type=box, size=(*half[:2], 0.007), rgba=clear, group=HIDDEN_GROUP)
    return ObjectModel(category=TARGET_ZONE, spec=spec, horizontal_radius=half[0])
