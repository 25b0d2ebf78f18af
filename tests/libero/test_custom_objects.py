"""User-defined objects with meshes, registered as in the walkthrough, in scenes, task files and environments."""

import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from libero._adapters.models import model_of
from libero.libero.envs import ControlEnv, OffScreenRenderEnv
from libero.libero.envs.base_object import OBJECTS_DICT, MujocoXMLObject, register_object
from libero.libero.envs.objects import ArticulatedObject, get_object_fn
from libero.libero.utils.object_utils import get_affordance_regions
from libero.libero.utils.task_generation_utils import generate_bddl_from_task_info, register_task_info
from libero_env.errors import LiberoError
from libero_env.objects import get_object
from tests.harness.scenes import register_scene, write_box

pytestmark = pytest.mark.sim

# As the walkthrough prints it: one body, one mesh, no groups, no sites.
PLAIN = """
<mujoco model="{name}">
<asset>
<mesh name="{name}_mesh" file="{name}.obj"/>
</asset>
<worldbody>
<body name="{name}">
<geom type="mesh" mesh="{name}_mesh"
rgba="0.8 0.8 0.8 1"
friction="0.95 0.3 0.1"/>
</body>
</worldbody>
</mujoco>
"""
DRAWER = """
<mujoco model="tool_box">
  <worldbody><body>
    <body name="object">
      <geom type="box" size="0.10 0.10 0.005" group="0"/>
      <geom type="box" size="0.10 0.10 0.005" group="1" rgba="0.6 0.3 0.1 1" contype="0" conaffinity="0"/>
      <body name="drawer" pos="0 0 0.05">
        <joint name="slide" type="slide" axis="1 0 0" range="0 0.15" damping="5"/>
        <geom type="box" size="0.08 0.08 0.02" group="0"/>
        <geom type="box" size="0.08 0.08 0.02" group="1" rgba="0.9 0.6 0.3 1" contype="0" conaffinity="0"/>
        <site name="inner_region" type="box" size="0.07 0.07 0.02" rgba="0 0 0 0"/>
      </body>
    </body>
    <site name="bottom_site" pos="0 0 -0.005"/>
    <site name="top_site" pos="0 0 0.07"/>
    <site name="horizontal_radius_site" pos="0.1 0.1 0"/>
  </body></worldbody>
</mujoco>
"""


@pytest.fixture
def assets(tmp_path, monkeypatch):
    """The folder `custom_assets` of the walkthrough, here."""
    for name, half in (("libero_mug", 0.03), ("libero_mug_yellow", 0.02)):
        folder = tmp_path / "custom_assets" / name
        folder.mkdir(parents=True)
        (folder / f"{name}.xml").write_text(PLAIN.format(name=name))
        write_box(folder / f"{name}.obj", half, offset=0.01)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class CustomObject(MujocoXMLObject):
    def __init__(self, name, obj_name):
        path = os.path.abspath(os.path.join("./", "custom_assets", obj_name, f"{obj_name}.xml"))
        joints = [{"type": "free", "damping": "0.0005"}]
        super().__init__(path, name=name, joints=joints, obj_type="all", duplicate_collision_geoms=False)
        self.category_name = "_".join(re.sub(r"([A-Z])", r" \1", self.__class__.__name__).split()).lower()
        self.object_properties = {"vis_site_names": {}}


def register_mugs():
    @register_object
    class LiberoMug(CustomObject):
        def __init__(self, name="libero_mug", obj_name="libero_mug"):
            super().__init__(name, obj_name)
            self.rotation = {"x": (-np.pi / 2, -np.pi / 2), "y": (-np.pi, -np.pi), "z": (np.pi, np.pi)}
            self.rotation_axis = None

    @register_object
    class LiberoMugYellow(CustomObject):
        def __init__(self, name="libero_mug_yellow", obj_name="libero_mug_yellow"):
            super().__init__(name, obj_name)
            self.rotation, self.rotation_axis = (0.0, 0.0), "z"

    return LiberoMug


def test_the_walkthrough_from_class_to_environment(assets):
    mug = register_mugs()
    assert get_object_fn("libero_mug") is mug
    places = {"libero_mug": (0.0, 0.0), "libero_mug_yellow": (0.2, 0.0), "plate": (-0.2, 0.0)}
    register_scene("KitchenDemoScene", "wooden_cabinet", **places)

    @register_task_info
    class KitchenDemoScenePutMugsOnPlate:
        task_name = "KITCHEN_DEMO_SCENE_put_both_mugs_on_the_plate"
        scene_name = "KitchenDemoScene"
        language_instruction = "put the libero mug and yellow mug on the plate"
        goal = [("On", "libero_mug_1", "plate_1"), ("On", "libero_mug_yellow_1", "plate_1")]

    path = generate_bddl_from_task_info(KitchenDemoScenePutMugsOnPlate(), output_dir="./custom_pddl")
    env = OffScreenRenderEnv(bddl_file_name=path, camera_heights=64, camera_widths=64)
    env.seed(1)
    before = env.reset()["libero_mug_1_pos"]
    shown = env.env.objects_dict["libero_mug_1"]
    assert type(shown) is mug and shown.joints == ["libero_mug_1_joint0"]
    assert np.allclose(before[:2], (0.0, 0.0), atol=0.03)
    for _ in range(5):
        obs, _, done, _ = env.step([0.0] * 7)
    assert np.allclose(obs["libero_mug_1_pos"], before, atol=0.005), "it is at rest on the table"
    assert not done
    model = env.sim.model
    seen = [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body_name2id("libero_mug_1_main")]
    assert {int(model.geom_group[g]) for g in seen} == {0, 1}, "what has no visual geom is seen as it is"
    env.close()


def test_rotation_may_be_a_range_or_one_for_each_axis(assets):
    register_mugs()
    assert get_object("libero_mug").rotation.keys() == {"x", "y", "z"}
    assert get_object("libero_mug_yellow").rotation == {"z": (0.0, 0.0)}


def test_offsets_missing_in_a_plain_file_are_measured(assets):
    register_mugs()
    model = get_object("libero_mug")
    assert np.allclose([model.bottom_offset[2], model.top_offset[2]], [-0.02, 0.04], atol=1e-6)
    assert model.horizontal_radius == pytest.approx(0.03)
    compiled = model.spec.compile()
    assert compiled.body_mass[1] == pytest.approx(1000 * 0.06**3, rel=1e-6), "that of water"


def test_invalid_files_are_reported(tmp_path):
    class Thing(MujocoXMLObject):
        def __init__(self, file, name="thing"):
            super().__init__(file, name=name)

    for text, words in (
        ("<mujoco><worldbody/></mujoco>", "no body with a geom"),
        (PLAIN.format(name="thing"), "thing.obj: no such file"),
        ("<mujoco><worldbody><body><geom size='1 a'/></body></worldbody></mujoco>", "MuJoCo cannot read it"),
        ("<mujoco", "thing.xml"),
    ):
        (tmp_path / "thing.xml").write_text(text)
        os.utime(tmp_path / "thing.xml", ns=(0, hash(words) & 0xFFFFFFF))
        with pytest.raises(LiberoError, match=words):
            model_of(Thing(tmp_path / "thing.xml"), "thing")
    with pytest.raises(TypeError, match="no MJCF file"):
        MujocoXMLObject(name="thing")
    assert Thing(tmp_path / "thing.xml").file == MujocoXMLObject(custom_path=tmp_path / "thing.xml").file


def test_user_defined_articulated_objects(tmp_path):
    """A fixture with a drawer that a task opens: the family's base class, with a file that is named by its path."""
    (tmp_path / "tool_box.xml").write_text(DRAWER)

    @register_object
    class ToolBox(ArticulatedObject):
        def __init__(self, name="tool_box", obj_name=str(tmp_path / "tool_box.xml"), joints=None):
            super().__init__(name, obj_name, joints)
            self.object_properties["articulation"]["default_open_ranges"] = [0.10, 0.15]
            self.object_properties["articulation"]["default_close_ranges"] = [0.0, 0.005]

    assert get_affordance_regions(["tool_box"]) == {"tool_box": ["inner_region"]}

    register_scene("Workshop", "tool_box", butter=(0.0, 0.1))
    info = register_task_info("open the box", "workshop", goal_states=[("Open", "tool_box_1_inner_region")])
    env = ControlEnv(bddl_file_name=generate_bddl_from_task_info(info, tmp_path), use_camera_obs=False)
    env.seed(0)
    env.reset()
    box = env.env.fixtures_dict["tool_box_1"]
    assert (type(box), box.joints) == (ToolBox, ["tool_box_1_slide"])
    drawer = env.env.object_states_dict["tool_box_1_inner_region"]
    assert (drawer.is_open(), drawer.is_close(), env.check_success()) == (False, True, False)
    drawer.set_joint(0.14)
    assert (drawer.is_open(), env.check_success()) == (True, True)
    env.close()


ROBOSUITE = """
import numpy as np, os, sys
from robosuite.models.objects import MujocoXMLObject
from libero.libero.envs.base_object import register_object
from libero.libero.envs.objects import get_object_dict
from libero_env.objects import get_object

@register_object
class LiberoMug(MujocoXMLObject):
    def __init__(self, name="libero_mug", obj_name="libero_mug"):
        super().__init__(os.path.abspath("custom_assets/libero_mug/libero_mug.xml"), name=name,
                         joints=[dict(type="free", damping="0.0005")], obj_type="all", duplicate_collision_geoms=False)
        self.rotation, self.rotation_axis = {"x": (-np.pi/2, -np.pi/2), "y": (0, 0), "z": (0, 2*np.pi)}, None

mug = get_object_dict()["libero_mug"](name="libero_mug_1")
print(mug.joints, f"{mug.bottom_offset[2]:.3f} {mug.horizontal_radius:.3f}")
model = get_object("libero_mug")
print(f"{model.horizontal_radius:.3f}", sorted(model.rotation), model.joint_damping)
"""


def test_subclasses_of_robosuites_own_class(assets):
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-W", "ignore", "-c", ROBOSUITE]
    done = subprocess.run(command, env=env, cwd=assets, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.strip().splitlines()[-2:]
    assert first == "['libero_mug_1_joint0'] -0.020 0.030"
    assert second == "0.030 ['x', 'y', 'z'] 0.0005"


def test_meshes_are_counted_once(assets):
    """Reading a file again gives the same model; a changed file gives the changed one."""
    register_mugs()
    first = get_object("libero_mug").horizontal_radius
    file = assets / "custom_assets" / "libero_mug" / "libero_mug.xml"
    file.write_text(file.read_text().replace("libero_mug.obj", "../libero_mug_yellow/libero_mug_yellow.obj"))
    os.utime(file, (0, 0))
    assert (first, get_object("libero_mug").horizontal_radius) == (pytest.approx(0.03), pytest.approx(0.02))
    assert mujoco.MjModel.from_xml_string(get_object("libero_mug").spec.to_xml()).nmesh == 1


BRICK = """
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


@pytest.fixture
def brick(tmp_path):
    (tmp_path / "brick.xml").write_text(BRICK)
    return str(tmp_path / "brick.xml")


def task_with(category, suite, folder):
    """Return the path of a task that has an object of a category instead of the milk."""
    text = Path(suite.get_task_bddl_file_path(0)).read_text()
    (folder / "task.bddl").write_text(
        text.replace("milk_1", f"{category}_1").replace("- milk", f"- {category}")
    )
    return folder / "task.bddl"


def test_objects_that_robosuite_generates(tmp_path, suite):
    objects = pytest.importorskip("robosuite.models.objects")

    @register_object
    class SmallBox(objects.BoxObject):
        def __init__(self, name="small_box", obj_name="small_box"):
            super().__init__(name=name, size=[0.02, 0.02, 0.03], rgba=[1, 0, 0, 1])

    OBJECTS_DICT["small_ball"] = lambda name: objects.BallObject(name=name, size=[0.025], rgba=[0, 1, 0, 1])
    for category, bottom, mass in (
        ("small_box", -0.03, 0.096),
        ("small_ball", -0.025, 1000 * 4 / 3 * np.pi * 0.025**3),
    ):
        env = ControlEnv(bddl_file_name=task_with(category, suite, tmp_path), use_camera_obs=False)
        assert env.reset()[f"{category}_1_pos"][2] == pytest.approx(-bottom, abs=2e-3)
        assert env.env.get_object(f"{category}_1").bottom_offset[2] == bottom
        body = env.sim.model.body_name2id(f"{category}_1_main")
        assert env.sim.model.body_mass[body] == pytest.approx(mass)
        assert env.env.check_contact(env.env.get_object(f"{category}_1")), "its geoms have their names there"
        env.close()


def test_offsets_of_a_class_are_those_of_placement(brick, tmp_path, suite):
    @register_object
    class WideBrick(MujocoXMLObject):
        horizontal_radius, bottom_offset = 0.09, np.array([0.0, 0.0, -0.05])

        def __init__(self, name="wide_brick", obj_name="wide_brick"):
            super().__init__(brick, name=name, joints=[{"type": "free", "damping": "0.001"}])

    model = get_object("wide_brick")
    assert (model.horizontal_radius, model.bottom_offset) == (0.09, (0.0, 0.0, -0.05))
    assert model.top_offset == (0.0, 0.0, 0.03), "of the file"
    env = ControlEnv(bddl_file_name=task_with("wide_brick", suite, tmp_path), use_camera_obs=False)
    assert "wide_brick_1_pos" in env.reset()
    assert env.env.objects_dict["wide_brick_1"].joints == ["wide_brick_1_joint0"]
    env.close()


def test_subclasses_of_the_benchmarks_classes_have_its_models(tmp_path, suite):
    """As in the original: the file of the nearest class, or of the category that is named."""
    milk, ketchup = get_object_fn("milk"), get_object_fn("ketchup")

    @register_object
    class RedCan(milk):
        pass

    @register_object
    class SmallCan(milk):
        def __init__(self, name="small_can", obj_name="ketchup"):
            super().__init__(name, obj_name)
            self.rotation, self.rotation_axis = (0.5, 0.5), "y"

    OBJECTS_DICT["blue_can"] = lambda name: ketchup(name=name)
    assert get_object("red_can").rotation == get_object("milk").rotation
    assert get_object("small_can").rotation == {"y": (0.5, 0.5)}
    for category, cls, model in (
        ("red_can", RedCan, "milk"),
        ("small_can", SmallCan, "ketchup"),
        ("blue_can", ketchup, "ketchup"),
    ):
        path = task_with(category, suite, tmp_path)
        path.write_text(path.read_text().replace("butter_1 - butter", f"butter_1 - {model}"))
        env = ControlEnv(bddl_file_name=path, use_camera_obs=False)
        env.reset()
        own, same = (env.env.get_object(f"{name}_1") for name in (category, "butter"))
        assert type(own) is cls and (own.bottom_offset == same.bottom_offset).all()
        masses = [env.sim.model.body_mass[env.sim.model.body_name2id(item.root_body)] for item in (own, same)]
        assert masses[0] == masses[1]
        env.close()


def test_a_class_of_the_benchmark_can_be_replaced(brick, suite):
    family, mass = get_object_fn("milk").__base__, get_object("milk").spec.compile().body_mass[1]
    for file, expected in (("milk", mass), (brick, 0.048)):

        @register_object
        class Milk(family):
            def __init__(self, name="milk", obj_name=file):
                super().__init__(name, obj_name)

        env = ControlEnv(bddl_file_name=suite.get_task_bddl_file_path(0), use_camera_obs=False)
        env.reset()
        assert type(env.env.get_object("milk_1")) is Milk
        assert env.sim.model.body_mass[env.sim.model.body_name2id("milk_1_main")] == pytest.approx(expected)
        env.close()
