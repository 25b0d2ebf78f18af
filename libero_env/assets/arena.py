"""Where a task happens: floor or table, cameras, lights, walls, and the builtin pack's furniture around them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from libero_env.assets import furnishing
from libero_env.assets.own_arena import read_own, read_room, require_reach
from libero_env.assets.robot import load_robosuite
from libero_env.errors import UnknownNameError
from libero_env.mujoco_compat import delete, make_directional, mujoco
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.storage import read_yaml
from libero_env.workspaces import BUILTIN_WORKSPACES, WORKSPACES, find_workspace

SPARE = "spare_"  # prefix of materials that nothing has
_ROOM = "room"  # file with the parameters that all workspaces share
_MOUNT_LIFT = 0.01  # [m] height of the mount's origin above the arm's
_SEEN: Mapping[str, Any] = {"group": 1, "contype": 0, "conaffinity": 0}  # geoms of the room
_FAR = 2.0  # [m] length of a surface whose size is not known
_SHARED = ("cameras", "lights", "walls", "floor")


@dataclass(frozen=True)
class Workspace:
    """Table or floor that a task takes place on. World frame.

    It is from a file in `libero_env/assets/workspaces`, or a user's own, see `libero_env.assets.own_arena`.

    Attributes:
        name: Fixture category, such as `kitchen_table`.
        offset: Origin of the regions, (3,) [m].
        region_height: Height of the surface that objects stand on above `offset`, [m].
        zone_origin: Origin of the flat boxes over regions, which goals refer to, (3,) [m]. Its z is the centre of the
            boxes; the original has another height in each problem.
        robot_base_pos: Origin of `robot0_base`, (3,) [m].
        mount: Name of the mount below the arm, `rethink`; None where there is none.
        parameters: Content of the file.
    """

    name: str
    problem: str
    offset: tuple[float, float, float]
    region_height: float
    zone_origin: tuple[float, float, float]
    robot_base_pos: tuple[float, float, float]
    mount: str | None
    parameters: Mapping[str, Any]

    @property
    def surface_height(self) -> float:
        """World z of the surface that objects stand on, [m]."""
        return self.offset[2] + self.region_height

    @property
    def own(self) -> str | None:
        """Digest of the files of a user's workspace; None for those of the benchmark."""
        return self.parameters.get("own")


def load_workspace(category: str) -> Workspace:
    """Return the workspace that a fixture category stands for.

    Raises:
        UnknownNameError: The workspace does not exist; the message lists the valid ones.
        InvalidInputError: A file of a user's workspace is not valid.
    """
    if category in BUILTIN_WORKSPACES:
        return _builtin(category)
    if (directory := find_workspace(category)) is None:
        raise UnknownNameError("workspace", category, WORKSPACES)
    given, origin, changes = read_own(directory)
    base = load_workspace(given["extends"])
    shift = np.zeros(3) if origin is None else origin - (*base.offset[:2], base.surface_height)
    x, y, z = base.robot_base_pos
    cameras = base.parameters["cameras"].items()
    moved = {name: {**camera, "pos": list(camera["pos"] + shift)} for name, camera in cameras}
    robot = tuple(given.get("robot", (x + shift[0], y + shift[1], z)))
    surface = (base.offset[0] + shift[0], base.offset[1] + shift[1], base.surface_height + shift[2])
    require_reach(directory, robot, surface, given["table"]["size"] if "table" in given else (_FAR, _FAR))
    return replace(
        base,
        name=category,
        problem=_own_problem(category),
        offset=tuple(base.offset + shift),
        zone_origin=tuple(base.zone_origin + shift),
        robot_base_pos=robot,
        parameters={**base.parameters, "cameras": moved, **changes},
    )


@cache
def _builtin(category: str) -> Workspace:
    room, specific = (read_yaml(f"assets/workspaces/{name}.yaml") for name in (_ROOM, category))
    parameters = dict(specific)
    for key in _SHARED:  # entries that are null in the specific file are left out
        both = {**room[key], **specific.get(key, {})}
        parameters[key] = {name: value for name, value in both.items() if value is not None}
    return Workspace(
        name=category,
        problem=parameters["problem"],
        offset=tuple(parameters["offset"]),
        region_height=parameters["region_height"],
        zone_origin=tuple(parameters["zone_origin"]),
        robot_base_pos=tuple(parameters["robot"]["base_pos_world"]),
        mount=parameters["robot"]["mount"],
        parameters=parameters,
    )


def workspace_of_problem(problem: str) -> Workspace:
    """Return the workspace of a problem class, such as `LIBERO_Floor_Manipulation`, ignoring case.

    Raises:
        UnknownNameError: The problem class does not exist; the message lists the valid ones.
    """
    categories = {_builtin(name).problem: name for name in BUILTIN_WORKSPACES}
    categories |= {_own_problem(name): name for name in WORKSPACES if name not in BUILTIN_WORKSPACES}
    for name, category in categories.items():
        if name.casefold() == problem.casefold():
            return load_workspace(category)
    raise UnknownNameError("problem", problem, categories)


def _own_problem(workspace: str) -> str:
    return f"LIBERO_{workspace.title()}_Manipulation"


def add_arena(spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]) -> None:
    """Add cameras, lights, floor, walls and the table to a scene.

    Args:
        spec: Scene to extend.
        scene_properties: `:scene_properties` of the task file: `floor` and `wall` name the style of each, `scene` that
            of the whole scene. Styles that are not given are those of the workspace's file.

    Raises:
        UnknownNameError: A property or a style does not exist; the message lists the valid ones.
    """
    parameters, valid, world = workspace.parameters, furnishing.load_styles(), spec.worldbody
    styles = furnishing.chosen_styles(parameters["styles"], scene_properties)
    add_cameras_and_lights(spec, workspace)
    if "model" in parameters:
        room, _ = read_room(parameters["model"])
        spec.attach(room, prefix="room_", frame=world.add_frame())
        return
    ground = world.add_body(name=parameters["floor_body"]) if parameters["floor_body"] else world
    furnishing.add_material(spec, "floor", valid["floor"][styles["floor"]])
    plane, size = mujoco.mjtGeom.mjGEOM_PLANE, parameters["floor"]["size"]
    ground.add_geom(name="floor", type=plane, size=size, material="floor", group=1, condim=3)
    furnishing.add_material(spec, "wall", valid["wall"][styles["wall"]], *parameters["wall_gloss"])
    for name, wall in parameters["walls"].items():
        world.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, material="wall", **_SEEN, **wall)
    if parameters.get("table"):
        _add_table(spec, parameters["table"])
    more = valid["scene"][styles["scene"]].get("furniture", ())
    if sets := tuple(dict.fromkeys([*parameters.get("furniture", ()), *more])):
        furnishing.add_visual_mesh(spec, world, "furniture", furnishing.furniture(sets))


def add_cameras_and_lights(spec: mujoco.MjSpec, workspace: Workspace) -> None:
    """Add the cameras that do not move with the robot, and the lights."""
    world = spec.worldbody
    for name, camera in workspace.parameters["cameras"].items():
        world.add_camera(name=name, pos=camera["pos"], quat=camera["quat"], fovy=camera["fovy_degrees"])
    for name, light in workspace.parameters["lights"].items():
        values = {"pos": light["pos"], "dir": light["dir"], "diffuse": [0.8] * 3}
        specular, directional = [light.get("specular", 0.3)] * 3, light.get("directional", False)
        add_light(spec, name, directional=directional, specular=specular, **values)


def surface_styles() -> dict[str, Mapping[str, Any]]:
    """Return the styles of floors, walls and tables by a name of their own, such as `floor_dark`."""
    known = furnishing.load_styles()
    styles = {f"{kind}_{name}": style for kind in ("floor", "wall") for name, style in known[kind].items()}
    tables = {name: _builtin(name).parameters.get("table") for name in BUILTIN_WORKSPACES}
    return styles | {f"table_{name}": table["style"] for name, table in tables.items() if table is not None}


def add_spare_materials(spec: mujoco.MjSpec) -> None:
    """Add the styles of all surfaces as materials that nothing has: a picture can be drawn with one of them instead."""
    for name, style in surface_styles().items():
        furnishing.add_material(spec, SPARE + name, style)


def add_light(spec: mujoco.MjSpec, name: str, *, directional: bool, **values: Sequence[float]) -> None:
    """Add a light that casts no shadow to the world; `values` are numbers of MJCF, such as `pos` and `diffuse`."""
    light = spec.worldbody.add_light(name=name, castshadow=False, **values)
    if directional:
        make_directional(light)


def add_mount(spec: mujoco.MjSpec, workspace: Workspace, detailed: bool = False) -> None:
    """Add the mount below the arm, if the workspace has one: names start with `mount0_`, the root is `mount0_base`.

    Args:
        spec: Scene to extend.
        detailed: Whether it has robosuite's visual mesh of 33,000 triangles.

    Raises:
        MissingPackageError: See `libero_env.assets.robot.robot_assets`.
    """
    if workspace.mount is None:
        return
    mount = load_robosuite(f"mounts/{workspace.mount}_mount.xml")
    mount.body("base").pos = [0.0, 0.0, 0.0]
    if detailed:
        mount.geom("pedestal_vis").mass = 0.0
    else:
        delete(mount, mount.geom("pedestal_vis"))
        delete(mount, mount.mesh("pedestal"))
        furnishing.add_visual_mesh(
            mount, mount.body("pedestal"), "pedestal_vis", furnishing.furniture((workspace.mount,))
        )
    # As in the original the arm carries its mount, which decides how sums round.
    arm = spec.body("robot0_base")
    base = (0.0, 0.0, 0.0) if arm else workspace.robot_base_pos
    frame = (arm or spec.worldbody).add_frame(pos=(*base[:2], base[2] + _MOUNT_LIFT))
    spec.attach(mount, prefix="mount0_", frame=frame)


def _add_table(spec: mujoco.MjSpec, table: Mapping[str, Any]) -> None:
    body = spec.worldbody
    for name, pos in table["bodies"].items():
        body = body.add_body(name=name, pos=pos)
    body.quat = table.get("quat", [1.0, 0.0, 0.0, 0.0])
    for box in table["collision"]:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            group=0,
            rgba=[0.5, 0.5, 0.5, 0.3],
            **{**table.get("contact", {}), **box},
        )
    furnishing.add_material(spec, "table", table["style"], *table["gloss"])
    for part in table.get("visual", ()):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{part['type'].upper()}")
        body.add_geom(material="table", **_SEEN, **{**part, "type": kind})
    if "shapes" in table:
        first = spec.body(next(iter(table["bodies"])))
        mesh = merge([furnishing.solid_mesh(shape) for shape in table["shapes"]])
        from_above = mesh.vertices[:, [1, 0]] / table["style"]["period"]  # the second texture axis is along y
        mesh = Mesh(mesh.vertices, mesh.faces, from_above)
        furnishing.add_visual_mesh(spec, first, "table_visual", mesh, "table")
    for name, pos in table.get("sites", {}).items():
        body.add_site(name=name, pos=pos, size=[0.001] * 3, rgba=[0.0] * 4)
