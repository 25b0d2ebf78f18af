"""The two models of the arm: that of robosuite 1.4.0, whose wrist touches nothing, and that of 1.4.1."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from libero_env.assets import robot as robots
from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS, add_panda, robot_assets
from libero_env.envs import BatchEnv, LiberoEnv
from libero_env.errors import UnknownNameError
from libero_env.sim.osc import rotate
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_task

pytestmark = pytest.mark.sim
WRIST = '<geom type="mesh" group="0" mesh="link7" name="link7_collision"/>'


def arm(name: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    add_panda(spec, (0.0, 0.0, 0.0), name)
    return spec.compile()


def shapes(model: mujoco.MjModel) -> list[bytes]:
    fields = ("geom_type", "geom_bodyid", "geom_dataid", "geom_contype", "geom_pos", "geom_quat", "geom_size")
    return [getattr(model, field).tobytes() for field in (*fields, "mesh_vert", "mesh_face", "body_mass")]


def colliders(model: mujoco.MjModel) -> list[str]:
    return [model.geom(g).name for g in np.flatnonzero(model.geom_contype)]


def test_only_the_wrist_differs():
    ours, later = (arm(name) for name in ROBOTS)
    assert set(colliders(later)) - set(colliders(ours)) == {"robot0_link7_collision"}
    assert later.ngeom == ours.ngeom + 1 and later.nq == ours.nq
    for field in ("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping", "jnt_range"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(later, field))


@pytest.mark.parametrize("name", ROBOTS)
def test_either_version_of_the_package_supplies_both(name, tmp_path, monkeypatch):
    folder, expected = robot_assets(), arm(name)
    text = (folder / "robots/panda/robot.xml").read_text()
    # an own folder with the file of the version that is not installed
    hand = '<body name="right_hand"'
    other = text.replace(WRIST, "") if WRIST in text else text.replace(hand, WRIST + hand)
    assert other != text
    for part in ("robots/panda", "grippers"):
        (tmp_path / part).mkdir(parents=True)
        for item in (folder / part).iterdir():
            (tmp_path / part / item.name).symlink_to(item)
    (tmp_path / "robots/panda/robot.xml").unlink()
    (tmp_path / "robots/panda/robot.xml").write_text(other)
    monkeypatch.setattr(robots, "robot_assets", lambda: Path(tmp_path))
    model = arm(name)
    assert shapes(model) == shapes(expected) and colliders(model) == colliders(expected)
    assert ("robot0_link7_collision" in colliders(model)) == (name != DEFAULT_ROBOT)


def test_environments_have_the_robot_that_they_name():
    task = get_task("libero_object/0")
    assert build_scene(task.problem).robot == DEFAULT_ROBOT
    env = BatchEnv(task, 2, cameras=(), robot="robosuite-1.4.1")
    assert env.scene.robot == "robosuite-1.4.1"
    assert "robot0_link7_collision" in colliders(env.scene.model)
    env.reset(options={"init_state": np.array([0, 1])})  # initial states are valid for both
    env.close()
    with pytest.raises(UnknownNameError, match=r"robosuite-1\.4\.1"):
        LiberoEnv(task, robot="robosuite-1.5")


def test_the_arm_carries_its_mount():
    model = build_scene(get_task("libero_goal/0").problem).model
    mount = model.body("mount0_base")
    assert model.body(mount.parentid[0]).name == "robot0_base"


def test_goal_rotations_round_as_robosuite_does():
    # quat2mat of robosuite 1.4.0 (utils/transform_utils.py) for these rotation vectors, on x86-64
    vectors = np.array([[0.3, -0.2, 0.5], [-0.01, 0.25, 0.125]])
    for vector in vectors:
        found = np.empty(9)
        rotate(vector, np.eye(3).ravel(), found)
        quat, exact = np.empty(4), np.empty(9)
        angle = np.linalg.norm(vector)
        mujoco.mju_axisAngle2Quat(quat, vector / angle, angle)
        mujoco.mju_quat2Mat(exact, quat)
        assert 0 < np.abs(found - exact).max() < 3e-7
        off_diagonal = ~np.eye(3, dtype=bool).ravel()
        assert (found[off_diagonal] == found[off_diagonal].astype(np.float32)).all()
