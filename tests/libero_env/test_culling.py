"""Leaving out what a camera cannot show changes no bit of an image."""

import copy
from functools import partial

import mujoco
import numpy as np
import pytest

from libero_env.sim.culling import Culling
from libero_env.sim.render import Renderer, RenderTarget
from libero_env.sim.scene import build_scene
from libero_env.sim.scene_spec import FAITHFUL, FAST
from libero_env.tasks import get_task

pytestmark = pytest.mark.sim

SIZE = 96
# Two reflective boxes, of which MuJoCo shows one, and bodies that are seen in it only, from a camera that turns.
MIRRORS = """
<mujoco>
  <visual><map znear="0.001"/><quality offsamples="4"/></visual>
  <asset><material name="shiny" reflectance="0.6" rgba="0.4 0.4 0.4 1"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="still" pos="1.5 0 1" xyaxes="0 1 0 -0.5 0 1"/>
    <geom type="box" group="1" size="0.3 0.2 0.05" pos="0.5 0 0" material="shiny"/>
    <geom type="box" group="1" size="0.2 0.3 0.05" pos="-0.6 0.1 0" material="shiny" euler="0 20 30"/>
    <geom type="sphere" group="1" size="0.1" pos="0.7 0 0.7" rgba="1 0 0 1"/>
    <geom type="capsule" group="1" size="0.05 0.3" pos="0 0.6 0.5" euler="40 0 0" rgba="0 1 0 0.5"/>
    <geom type="cylinder" group="1" size="0.1 0.2" pos="-0.5 -0.3 0.6" rgba="0 0 1 1"/>
    <geom type="ellipsoid" group="1" size="0.1 0.2 0.3" pos="0.2 -0.6 0.4" rgba="1 1 0 1"/>
    <geom type="plane" group="1" size="2 2 0.1" pos="0 0 -0.3" rgba="0.8 0.7 0.6 1"/>
    <body name="turning" pos="0 0 0.35"><joint type="ball"/>
      <geom size="0.01" group="3"/><camera name="eye" fovy="50"/>
    </body>
  </worldbody>
</mujoco>
"""


def random_qpos(model, rng):
    """The arm anywhere, objects anywhere around the table, drawers and doors anywhere in their range."""
    qpos = model.qpos0.copy()
    for joint in range(model.njnt):
        at = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            qpos[at : at + 3] = rng.uniform([-0.6, -0.6, 0.0], [0.4, 0.6, 1.3])
            qpos[at + 3 : at + 7] = rng.normal(size=4)
        elif model.jnt_limited[joint]:
            qpos[at] = rng.uniform(*model.jnt_range[joint])
    return qpos


def assert_unchanged(model, cameras, states, faithful):
    """Compare the images of all cameras where nothing is left out with those where what cannot be seen is."""
    data, make = mujoco.MjData(model), partial(Renderer, model, SIZE, SIZE, faithful=faithful)
    with make(cull=False) as whole, make() as culled:
        for qpos in states:
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            pairs = zip(images(whole, data, cameras), images(culled, data, cameras), strict=True)
            for one, other in pairs:
                assert np.array_equal(one, other)


def images(renderer, data, cameras):
    shape = (len(cameras), SIZE, SIZE)
    arrays = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.int32)
    ids = map(renderer.camera_id, cameras)
    targets = [RenderTarget(*views[:3], segmentation=views[3]) for views in zip(ids, *arrays, strict=True)]
    renderer.render(data, targets)
    return arrays


def left_out(model, data, camera, mirrors):
    """Indices of the visual geoms that a camera does not show, and their types."""
    scene, options = mujoco.MjvScene(model, maxgeom=model.ngeom + 10), mujoco.MjvOption()
    options.geomgroup[:] = [0, 1, 0, 0, 0, 0]
    mujoco.mjv_updateScene(model, data, options, None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene)
    geoms = scene.geoms[: scene.ngeom]
    return [
        (geom.objid, mujoco.mjtGeom(kind).name)
        for geom, kind in Culling(model).apply(data, model.camera(camera).id, 1.0, geoms, mirrors)
    ]


def test_geoms_are_left_out():
    model = mujoco.MjModel.from_xml_string(MIRRORS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)  # the camera looks down, at the mirrors and the plane
    names = {kind for _, kind in left_out(model, data, "eye", mirrors=True)}
    assert "mjGEOM_CYLINDER" in names and "mjGEOM_PLANE" not in names


@pytest.mark.parametrize("faithful", [True, False])
def test_mirrors_show_what_the_camera_does_not(faithful):
    model = mujoco.MjModel.from_xml_string(MIRRORS)
    states = np.random.default_rng(0).normal(size=(60, 4))
    states /= np.linalg.norm(states, axis=1, keepdims=True)
    assert_unchanged(model, ["eye", "still"], states, faithful)


@pytest.mark.parametrize(("key", "drawing"), [
    ("libero_goal/0", FAITHFUL), ("libero_goal/0", FAST), ("libero_10/3", FAST), ("libero_90/70", FAST)
])  # fmt: skip
def test_random_states_of_tasks(key, drawing):
    model = copy.copy(build_scene(get_task(key).problem, drawing=drawing).model)
    rng = np.random.default_rng(0)
    states = [random_qpos(model, rng) for _ in range(4)]
    assert_unchanged(model, ["agentview", "robot0_eye_in_hand"], states, drawing == FAITHFUL)

    def moving():  # the agent's camera anywhere above and below the table, and close to it
        for _ in range(6):
            model.cam_pos[model.camera("agentview").id] = rng.uniform([-0.8, -0.8, 0.3], [0.8, 0.8, 1.6])
            model.cam_quat[model.camera("agentview").id] = rng.normal(size=4)
            yield states[0]

    assert_unchanged(model, ["agentview"], moving(), drawing == FAITHFUL)


def left_out_of(model, pos=None, mat=None):
    """Names of the geoms that the agent's camera, which may be moved, does not show where all joints are zero."""
    data, camera = mujoco.MjData(model), model.camera("agentview").id
    mujoco.mj_forward(model, data)
    if pos is not None:
        data.cam_xpos[camera], data.cam_xmat[camera] = pos, np.ravel(mat)
    return {model.geom(geom).name for geom, _ in left_out(model, data, camera, mirrors=False)}


def test_a_table_hides_its_legs_unless_it_is_transparent():
    model = copy.copy(build_scene(get_task("libero_goal/0").problem, drawing=FAST).model)
    legs = {f"table_leg{k}_visual" for k in (1, 2, 3, 4)}
    assert legs <= left_out_of(model)
    down, from_below = ((0, 0, 1.2), np.eye(3)), ((1.5, 0, 0.4), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert {"floor", *legs} <= left_out_of(model, *down), "the table is all that is seen"
    far = {"table_leg2_visual", "table_leg3_visual"}  # the near ones are beside the view
    assert not far & left_out_of(model, *from_below)
    table = model.geom("table_visual")
    model.geom_rgba[table.id, 3] = model.mat_rgba[table.matid, 3] = 0.5
    assert not far & left_out_of(model)
    assert "floor" not in left_out_of(model, *down)
