"""User-defined objects, registered as in the original."""

import pytest

from libero.libero.envs import ControlEnv
from libero.libero.envs.base_object import OBJECTS_DICT, MujocoXMLObject, register_object
from libero_env.objects import catalog

pytestmark = pytest.mark.sim

MJCF = """
<mujoco>
  <worldbody><body>
    <body name="object">
      <geom type="box" size="0.02 0.02 0.03" density="500" group="0"/>
      <geom type="box" size="0.02 0.02 0.03" rgba="0.9 0.1 0.1 1" group="1" contype="0" conaffinity="0"/>
    </body>
    <site name="bottom_site" pos="0 0 -0.03"/>
    <site name="top_site" pos="0 0 0.03"/>
    <site name="horizontal_radius_site" pos="0.03 0 0"/>
  </body></worldbody>
</mujoco>
"""


def test_an_object_from_an_mjcf_file(tmp_path, suite):
    (tmp_path / "brick.xml").write_text(MJCF)
    try:

        @register_object
        class RedBrick(MujocoXMLObject):
            def __init__(self, name="red_brick", obj_name="red_brick"):
                joints = [{"type": "free", "damping": "0.001"}]
                super().__init__(str(tmp_path / "brick.xml"), name=name, joints=joints)
                self.rotation, self.rotation_axis = (0.0, 0.0), "z"

        assert OBJECTS_DICT["red_brick"](name="red_brick_1").joints == ["red_brick_1_joint0"]
        with open(suite.get_task_bddl_file_path(0)) as file:
            text = file.read().replace("milk_1", "red_brick_1").replace("- milk", "- red_brick")
        (tmp_path / "task.bddl").write_text(text)
        env = ControlEnv(bddl_file_name=tmp_path / "task.bddl", use_camera_obs=False)
        assert "red_brick_1_pos" in env.reset()
        assert env.env.objects_dict["red_brick_1"].horizontal_radius == 0.03
        assert env.sim.model.body_mass[env.sim.model.body_name2id("red_brick_1_main")] == pytest.approx(0.048)
        env.close()
    finally:
        OBJECTS_DICT.pop("red_brick", None)
        catalog._registered.pop("red_brick", None)
