"""YAML files of tasks, of objects, of protocols and of the user's configuration."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from libero_env.assets.arena import add_arena, load_workspace
from libero_env.assets.pack import chosen_assets
from libero_env.mujoco_compat import mujoco
from libero_env.objects import folder
from libero_env.paths import objects_dir
from libero_env.tasks import bddl, make_task, read_suite
from libero_env.tasks.cameras import Camera
from libero_env.tasks.problem import differences
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import changed_text, hostile, mutated

PLACES = {
    "wooden_cabinet_1": {"at": [0, -0.3], "yaw": "pi"},
    "akita_black_bowl_1": [0, 0],
    "plate": {"at": [0.05, 0.2], "half": [0.01, 0.02]},
}
TASK = {
    "scene": "kitchen",
    "furniture": ["wooden_cabinet"],
    "objects": ["akita_black_bowl", "plate"],
    "place": PLACES,
    "goal": ["On akita_black_bowl_1 plate_1", "Open wooden_cabinet_1_top_region"],
    "language": "Put the bowl on the plate",
}
DEFINITIONS = [
    TASK,
    {"scene": "kitchen_scene1", "objects": ["plate", {"butter": 2}],
     "place": {"plate_2": [0.1, 0.1], "butter_1": "plate_2", "butter_2": "In wooden_cabinet_1_top_region"},
     "goal": "(Or (Open wooden_cabinet_1_top_region) (Not (ForAll (?x - butter) (On ?x plate_2))))",
     "init_also": ["Open wooden_cabinet_1_top_region"], "language": "open it", "name": "one",
     "cameras": {"top": {"pos": [0, 0, 2], "lookat": [0, 0, 1], "fovy": 60},
     "side": {"pos": [0, 1, 1], "quat": [1, 1, 0, 0]}},
     "scene_properties": {"floor": "rustic_floor"}},
    {"fixtures": {"floor": "floor"}, "objects": ["$first", "basket"], "with": {"first": "milk", "at": [0.1, 0.2]},
     "regions": {"floor": {"middle": {"at": "$at", "half": 0.02, "yaw": ["-pi/4", 1.5], "rgba": [0, 0, 1, 0.5]},
     "edge": {"ranges": [[-0.2, -0.2, -0.1, -0.1]]}}, "basket_1": ["contain_region"]},
     "init": ["On ${first}_1 floor_middle", "On basket_1 floor_edge"], "obj_of_interest": ["milk_1"],
     "problem": "LIBERO_Floor_Manipulation", "goal": ["In milk_1 basket_1_contain_region"], "language": "put it in"},
    {**{key: value for key, value in TASK.items() if key not in ("goal", "language")},
     "tasks": [{"name": "a", "goal": "Up plate_1"}, {"name": "b", "goal": "Up akita_black_bowl_1"}]},
    {"scene": "scene.yaml", "goal": "Up milk_1", "with": {"other": "butter"}},
]  # fmt: skip
SCENE = {"scene": "base.yaml", "objects": ["$other"], "place": {"$other": [0, 0.2]}}
BASE = {
    "fixtures": {"floor": "floor"},
    "objects": ["milk"],
    "regions": {"floor": {"middle": {"at": [0, 0], "half": 0.02}}},
    "init": ["On milk_1 floor_middle"],
}
OBJECT = {
    "bottom_offset": [0, 0, -0.03],
    "top_offset": [0, 0, 0.03],
    "horizontal_radius": 0.04,
    "joint_damping": 0.0005,
    "rotation": {"z": [0, 1.5]},
    "rotation_axis": "z",
    "articulation": {"open": [0.1, 0.2], "close": [0.0, 0.01]},
}
MODEL = """<mujoco><worldbody><body name="main"><geom name="g0" type="box" size="0.02 0.02 0.02" mass="0.1"/></body>
</worldbody></mujoco>"""


def write(path: Path, data: object) -> Path:
    path.write_text(
        data if isinstance(data, str) else yaml.safe_dump(data, sort_keys=False, allow_unicode=True),
        "utf-8",
        "replace",
    )
    return path


def read_tasks(path: Path):
    """Read a file, and what the tasks of it say, as a run would that stores them."""
    suite = read_suite([path])
    for task in suite.tasks:
        assert differences(bddl.parse(task.bddl_text), task.problem) == []
    return suite


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("fuzz")
    write(place / "scene.yaml", SCENE)
    write(place / "base.yaml", BASE)
    return place


@given(definition=mutated(DEFINITIONS))
@examples(short=250, long=6000)
def test_a_changed_task_is_read_or_refused(place, definition):
    path = write(place / "task.yaml", definition)
    survive("YAML tasks", lambda: read_tasks(path))


@given(definition=mutated([SCENE, BASE]))
@examples(short=60, long=2000)
def test_a_changed_scene_is_read_or_refused(tmp_path_factory, definition):
    place = tmp_path_factory.mktemp("scene")
    write(place / "base.yaml", BASE)
    write(place / "scene.yaml", definition)
    path = write(place / "task.yaml", DEFINITIONS[-1])
    survive("YAML tasks", lambda: read_tasks(path))


@given(data=st.data())
@examples(short=100, long=3000)
def test_a_changed_text_is_read_or_refused(place, data):
    text = yaml.safe_dump(data.draw(st.sampled_from(DEFINITIONS)), sort_keys=False)
    path = write(place / "text.yaml", data.draw(changed_text(text)))
    survive("YAML tasks", lambda: read_tasks(path))


@given(
    definition=mutated(DEFINITIONS[:3]),
    key=st.sampled_from(["objects", "place", "goal", "with", "name"]),
    value=hostile,
)
@examples(short=60, long=2000)
def test_a_call_makes_a_task_or_refuses(definition, key, value):
    if isinstance(definition, dict):
        definition = {str(k): v for k, v in definition.items()}
        survive("make_task", lambda: make_task(**{**definition, key: value}))
        survive("make_task", lambda: make_task(**definition))


@given(properties=mutated([OBJECT]))
@examples(short=80, long=2000)
def test_a_changed_object_is_read_or_refused(place, properties):
    own = place / "thing"
    own.mkdir(exist_ok=True)
    (own / "object.xml").write_text(MODEL)
    write(own / "object.yaml", properties)
    survive("object.yaml", lambda: folder.load(own, "thing").rest_quat())


@given(config=mutated([{"assets": "builtin", "objects": "here", "benchmark_root": "x", "robot": "libero"}]))
@examples(short=40, long=1000)
def test_a_changed_configuration_of_the_user_is_read_or_refused(place, config):
    write(place / "config.yaml", config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_CONFIG_PATH", str(place))
        for name in ("LIBERO_OBJECTS", "LIBERO_ASSETS"):
            patch.delenv(name, raising=False)
        survive("config.yaml", lambda: (objects_dir(), chosen_assets()))


ROOM = """<mujoco><worldbody><geom name="floor" type="plane" size="2 2 0.1"/>
<body pos="0 0 0.5"><geom type="box" size="0.4 0.4 0.1"/><site name="table_top" pos="0 0 0.1"/></body>
</worldbody></mujoco>
"""


@given(
    definition=mutated(
        [
            {"extends": "table", "table": {"pos": [0, 0.1, 0.8], "size": [1, 1]}},
            {"extends": "floor", "model": "room.xml", "robot": [-0.6, 0, 0]},
        ]
    ),
    room=changed_text(ROOM),
)
@examples(short=60, long=2000)
def test_a_changed_workspace_is_built_or_refused(place, definition, room):
    own = place / "workspaces" / "bench"
    own.mkdir(parents=True, exist_ok=True)
    (own / "room.xml").write_text(room, "utf-8", "replace")
    write(own / "workspace.yaml", definition)

    def build():
        spec = mujoco.MjSpec()
        add_arena(spec, load_workspace("bench"), {})
        return spec.compile()

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_OBJECTS", str(own.parent))
        survive("workspaces", build)


PARTS = (
    *("top", "pos=0 0 1", "lookat=0 0 0", "quat=1 0 0 0", "fovy=30", "body=plate_1"),
    *("pos=0 0 1e-300", "pos=nan 0 0"),
)


@given(
    st.lists(st.sampled_from(PARTS), max_size=6).map(",".join).flatmap(changed_text) | st.text(max_size=60)
)
@examples(200, 4000)
def test_the_text_of_a_camera_is_a_camera_or_one_line(text):
    camera = survive("cameras", lambda: Camera.read(text))
    if camera is not None:
        assert Camera.read(str(camera)) == camera
        if camera.quat is None:
            assert np.isfinite(camera.axes()).all()
