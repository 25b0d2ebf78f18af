"""Leaving out what a camera cannot show changes no bit of an image."""

import mujoco
import numpy as np
import pytest

from libero_env.sim.render import Renderer, RenderTarget
from libero_env.sim.scene import FAITHFUL, build_scene
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


def render_both(model, cameras, states, faithful):
    """Images with and without culling, of each state and camera; how many geoms were left out in all."""
    data = mujoco.MjData(model)
    with (
        Renderer(model, SIZE, SIZE, faithful=faithful, cull=False) as whole,
        Renderer(model, SIZE, SIZE, faithful=faithful) as culled,
    ):
        for qpos in states:
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            for camera in cameras:
                yield [images(renderer, data, renderer.camera_id(camera)) for renderer in (whole, culled)]


def images(renderer, data, camera):
    rgb, depth = np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros((SIZE, SIZE), np.float32)
    elements = np.zeros((SIZE, SIZE), np.int32)
    renderer.render(data, [RenderTarget(camera, rgb, depth, segmentation=elements)])
    drawn = sum(g.type != mujoco.mjtGeom.mjGEOM_NONE for g in renderer._geoms[: renderer._scene.ngeom])
    return rgb, depth, elements, drawn


def assert_equal(pairs):
    drawn = np.zeros(2, int)
    for whole, culled in pairs:
        for one, other in zip(whole[:3], culled[:3], strict=True):
            assert np.array_equal(one, other)
        drawn += whole[3], culled[3]
    assert drawn[1] < drawn[0]


def test_mirrors_show_what_the_camera_does_not():
    model = mujoco.MjModel.from_xml_string(MIRRORS)
    rng = np.random.default_rng(0)
    states = rng.normal(size=(60, 4))
    assert_equal(render_both(model, ["eye"], states / np.linalg.norm(states, axis=1, keepdims=True), True))


@pytest.mark.parametrize("key", ["libero_goal/0", "libero_10/3"])
def test_random_states_of_tasks(key):
    model = build_scene(get_task(key).problem, drawing=FAITHFUL).model
    rng = np.random.default_rng(0)
    states = [random_qpos(model, rng) for _ in range(4)]
    assert_equal(render_both(model, ["agentview", "robot0_eye_in_hand"], states, True))


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
