"""The editable model of a problem's scene: workspace, robot, objects and fixtures, cameras and zones."""

from collections.abc import Mapping, Sequence

import numpy as np

from libero_env.assets.arena import Workspace, add_mount, load_workspace
from libero_env.assets.original import OriginalPack
from libero_env.assets.pack import Pack, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT, add_panda
from libero_env.errors import UnknownNameError
from libero_env.mujoco_compat import mujoco, set_damping
from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.tasks.cameras import Camera, require_own_names
from libero_env.tasks.problem import Problem, Region
from libero_env.timing import TIMESTEP
from libero_env.workspaces import WORKSPACES

FAST, FAITHFUL = DRAWINGS = ("fast", "faithful")
BUFFER_SIDE = 1024  # [pixels] size of the offscreen buffer, which larger images enlarge


_FIXTURE_LIFT = 0.01  # [m] height of fixtures over the underside of the table top, as in the original
_ZONE_HEIGHT = 0.014  # [m] of the box over a flat region


def default_drawing(pack: Pack) -> str:
    """Return how images of a pack's scenes are drawn by default: the original's faithfully, all others fast."""
    return FAITHFUL if isinstance(pack, OriginalPack) and pack.lod is None else FAST


def scene_spec(
    problem: Problem,
    pack: Pack | None = None,
    entities: Mapping[str, ObjectModel] | None = None,
    *,
    drawing: str | None = None,
    robot: str = DEFAULT_ROBOT,
    cameras: Sequence[Camera] = (),
) -> mujoco.MjSpec:
    """Return a new, editable model of a problem's scene.

    Args:
        problem: Problem to build.
        pack: Asset pack of the models; by default that of `select_pack`.
        entities: Models of objects and fixtures by name; by default those of the pack.
        drawing: One of `DRAWINGS`; by default that of `default_drawing`.
        robot: One of `libero_env.assets.robot.ROBOTS`.
        cameras: Cameras that are added, besides those of the problem.

    Raises:
        UnknownNameError: A category of objects or fixtures has no model, or the body of a camera does not exist.
        InvalidInputError: An added camera has the name of another.
    """
    pack = pack or select_pack()
    name, workspace = workspace_of(problem)
    spec = mujoco.MjSpec()
    spec.modelname = "libero"
    faithful = (drawing or default_drawing(pack)) == FAITHFUL
    _set_options(spec, samples=4 if faithful else 0)
    pack.add_arena(spec, workspace, problem.scene_properties)
    add_panda(spec, workspace.robot_base_pos, robot, detailed=faithful)
    add_mount(spec, workspace, detailed=faithful)
    _add_zones(spec, problem, name, workspace)
    for entity, category in problem.objects.items():
        item = pack.build(category) if entities is None else entities[entity]
        joint = item.spec.body(ROOT_BODY).add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
        set_damping(joint, item.joint_damping)
        spec.attach(item.spec, prefix=f"{entity}_", frame=spec.worldbody.add_frame())
    for entity, category in problem.fixtures.items():
        if entity != name:
            item = pack.build(category) if entities is None else entities[entity]
            body, pose = item.spec.body(ROOT_BODY), fixture_pose(problem, name, workspace, entity, item)
            body.pos, body.quat = pose[:3], pose[3:]
            spec.attach(item.spec, prefix=f"{entity}_", frame=spec.worldbody.add_frame())
    if faithful and isinstance(pack, OriginalPack):
        pack.restore_drawing(spec, workspace, problem.scene_properties)
    _add_cameras(spec, (*problem.cameras, *cameras))
    return spec


def workspace_of(problem: Problem) -> tuple[str, Workspace]:
    """Return the name of the fixture that is the workspace of a problem, and the workspace.

    Raises:
        UnknownNameError: None of the fixtures is a workspace.
    """
    for name, category in problem.fixtures.items():
        if category in WORKSPACES:
            return name, load_workspace(category)
    raise UnknownNameError("workspace among the fixtures", list(problem.fixtures.values()), WORKSPACES)


def fixture_pose(
    problem: Problem,
    workspace_name: str,
    workspace: Workspace,
    name: str,
    item: ObjectModel,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return the pose of a fixture in the region of its init atom.

    Args:
        problem: Problem that has the fixture.
        workspace: Table or floor.
        rng: Generator to sample the region with; without it the middle of the region is taken.

    Returns:
        Position and quaternion wxyz, (7,).
    """
    region = problem.region(problem.places.get(name, ""))
    height = _FIXTURE_LIFT - workspace.parameters.get("table_thickness", 0.05) - item.bottom_offset[2]
    if region is None or not region.ranges or region.target != workspace_name:
        x, y, yaw = 0.0, 0.0, 0.0
    elif rng is None:
        x0, y0, x1, y1 = region.ranges[0]
        x, y, yaw = (x0 + x1) / 2, (y0 + y1) / 2, float(np.mean(region.yaw[0])) if region.yaw else 0.0
    else:
        x0, y0, x1, y1 = region.ranges[rng.integers(len(region.ranges))]
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        yaw = rng.uniform(*region.yaw[0]) if region.yaw else 0.0
    pos = np.add(workspace.offset, (x, y, height))
    return np.array([*pos, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def zone_boxes(region: Region, workspace: Workspace) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the flat box over each rectangle of a region: centre (3,) and half size (3,), world frame, m."""
    origin = np.array(workspace.zone_origin)
    return [
        (origin + ((x0 + x1) / 2, (y0 + y1) / 2, 0.0), np.array([x1 - x0, y1 - y0, _ZONE_HEIGHT]) / 2)
        for x0, y0, x1, y1 in region.ranges
    ]


def _set_options(spec: mujoco.MjSpec, samples: int) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIMESTEP
    option.impratio = 20.0
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.density, option.viscosity = 1.2, 2e-5
    visual = spec.visual
    visual.map.znear = 0.001
    visual.quality.offsamples = samples  # four double the cost of an image
    visual.quality.shadowsize = 0  # no light casts a shadow, in the original neither
    visual.global_.offwidth = visual.global_.offheight = BUFFER_SIDE
    visual.headlight.ambient, visual.headlight.diffuse = [0.1] * 3, [0.4] * 3
    visual.headlight.specular = [0.5] * 3


def _add_cameras(spec: mujoco.MjSpec, cameras: Sequence[Camera]) -> None:
    """Add cameras to a complete scene; they come last, and change nothing for the others."""
    require_own_names(cameras, [camera.name for camera in spec.cameras])
    bodies = {body.name: body for body in spec.bodies}
    for camera in cameras:
        body = bodies.get(camera.body) or bodies.get(f"{camera.body}_{ROOT_BODY}")
        if body is None:
            valid = [name.removesuffix(f"_{ROOT_BODY}") for name in bodies]
            raise UnknownNameError(f"body of camera {camera.name}", camera.body, valid)
        added = body.add_camera(name=camera.name, pos=camera.pos, fovy=camera.fovy)
        if camera.quat is not None:
            added.quat = np.array(camera.quat) / np.linalg.norm(camera.quat)
        else:
            added.alt.type, added.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, camera.axes()


def _add_zones(spec: mujoco.MjSpec, problem: Problem, name: str, workspace: Workspace) -> None:
    """Add a hidden site for each region on the workspace, so that it can be found by its address."""
    for region in problem.regions:
        if region.target == name and region.ranges:
            centre, half = zone_boxes(region, workspace)[0]
            spec.worldbody.add_site(
                name=region.address,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=centre,
                size=np.maximum(half, 1e-4),
                rgba=(0.0, 0.0, 0.0, 0.0),
                group=3,
            )
