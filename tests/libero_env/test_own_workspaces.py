"""A user's own workspaces: a table described in YAML, or a room in MJCF, that tasks take place on."""

import numpy as np
import pytest

from libero_cli.main import main
from libero_env import Expert, LiberoEnv, make_task
from libero_env.assets.arena import load_workspace
from libero_env.errors import InvalidInputError, LiberoError, UnknownNameError
from libero_env.tasks import bddl, write_task
from libero_env.workspaces import WORKSPACES

pytestmark = pytest.mark.sim
ROOM = """<mujoco>
  <asset><material name="grey" rgba="0.5 0.5 0.5 1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" material="grey"/>
    <body name="bench" pos="0.05 0.1 0.4">
      <geom name="top" type="box" size="0.4 0.6 0.02" pos="0 0 0.38"/>
      <site name="table_top" pos="0 0 0.4"/>
    </body>
  </worldbody>
</mujoco>
"""
TABLE = "extends: kitchen_table\ntable: {pos: [0.05, 0.1, 0.8], size: [0.8, 1.2]}\n"
MODEL = "extends: kitchen_table\nmodel: room.xml\n"
REGION = {"bench": {"corner": {"at": [0.1, 0.2], "half": 0.05}}}


@pytest.fixture
def bench(objects_home):
    """Return a function that writes the workspace `bench`."""

    def write(text: str, room: str = ROOM):
        folder = objects_home / "objects" / "bench"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "workspace.yaml").write_text(text)
        (folder / "room.xml").write_text(room)
        return folder

    return write


def task(**more):
    definition = {
        "scene": "bench",
        "objects": ["butter", "plate"],
        "place": {"butter_1": {"at": [0, 0], "half": 0}, "plate_1": {"at": [-0.1, -0.2], "half": 0}},
        "regions": REGION,
        "goal": "On butter_1 bench_corner",
        "language": "push the butter to the corner",
    }
    return make_task(**(definition | more))


@pytest.mark.parametrize("text", [TABLE, MODEL])
def test_objects_stand_where_the_workspace_says(bench, closing, text):
    """The surface is 0.8 m high and its middle at (0.05, 0.1): regions are relative to it."""
    bench(text)
    assert "bench" in WORKSPACES and "bench" in list(WORKSPACES)
    made = task()
    assert made.problem.name == "LIBERO_Bench_Manipulation" and bddl.parse(made.bddl_text) == made.problem
    env = closing(LiberoEnv(made, observations=("rgb", "objects"), camera_size=64))
    seen = env.reset(seed=0)[0]
    np.testing.assert_allclose(seen["butter_1_pos"][:2], [0.05, 0.1], atol=0.01)
    usual = task(scene="kitchen_table", goal="Up plate_1", regions={})
    there = closing(LiberoEnv(usual, cameras=(), observations=("objects",))).reset(seed=0)[0]
    assert seen["butter_1_pos"][2] - 0.8 == pytest.approx(there["butter_1_pos"][2] - 0.9, abs=1e-3)
    kitchen = load_workspace("kitchen_table")
    camera = env.scene.model.camera("agentview").pos
    np.testing.assert_allclose(camera - kitchen.parameters["cameras"]["agentview"]["pos"], [0.05, 0.1, -0.1])
    base = env.scene.workspace.robot_base_pos
    np.testing.assert_allclose(base, np.add(kitchen.robot_base_pos, [0.05, 0.1, 0]))
    assert seen["agentview_rgb"].std() > 10
    assert not env.step(np.zeros(7))[4]["success"]
    # the region's middle is 0.1, 0.2 from that of the table
    state = env.get_state()
    address = 1 + env.scene.pose_address("butter_1")
    state[address : address + 2] = 0.15, 0.3
    env.set_state(state)
    assert env.step(np.zeros(7))[4]["success"]


def test_a_plain_copy_of_the_kitchen_table_is_the_kitchen_table(bench, closing):
    """The same numbers as in the benchmark's file: the same pictures, to the bit."""
    bench("extends: kitchen_table\ntable: {pos: [0, 0, 0.9], size: [1.0, 1.2]}\n")
    own, builtin = (
        closing(LiberoEnv(task(scene=scene, goal="Up plate_1", regions={}), camera_size=64))
        for scene in ("bench", "kitchen_table")
    )
    state = builtin.reset(seed=0) and builtin.get_state()
    for key, value in builtin.set_state(state).items():
        np.testing.assert_array_equal(own.set_state(state)[key] if own.reset(seed=0) else None, value)


def test_the_expert_solves_a_task_in_a_room_of_ones_own(bench, closing):
    bench(MODEL)
    env = closing(LiberoEnv(task(goal="On butter_1 plate_1", regions={}), cameras=(), horizon=400))
    env.reset(seed=0)
    expert, over = Expert(env.task, np.random.default_rng(0)), False
    while not (over or expert.failure_reason):
        _, _, terminated, truncated, _ = env.step(expert.act(env.view))
        over = terminated or truncated
    assert terminated


def test_a_changed_workspace_is_another_scene(bench, closing):
    folder = bench(TABLE)
    first = closing(LiberoEnv(task(), cameras=())).scene
    (folder / "workspace.yaml").write_text(TABLE.replace("0.8]", "0.7]").replace("0.8,", "0.9,"))
    second = closing(LiberoEnv(task(), cameras=())).scene
    assert second.workspace.surface_height == 0.7 and first.digest != second.digest


def test_commands_know_own_workspaces(bench, tmp_path):
    bench(MODEL)
    path = tmp_path / "push.bddl"
    write_task(task(), path)
    assert main(["tasks", "lint", str(path)]) == 0
    words = ["preview", str(path), "--starts", "1", "--size", "64", "--out", str(tmp_path / "a.png")]
    assert main(["tasks", *words]) == 0


@pytest.mark.parametrize(("text", "room", "message"), [
    ("model: room.xml\n", ROOM, "extends is missing"),
    ("extends: kitchen\n", ROOM, "workspace.yaml:1: extends is 'kitchen'; expected 'table', 'kitchen_table'"),
    (TABLE + "model: room.xml\n", ROOM, "workspace.yaml:3: it has table and model; expected one of them"),
    (TABLE.replace("0.8]", "0]"), ROOM, "its top is 0 m over the floor"),
    (TABLE + "robot: [9, 9, 9]\n", ROOM, "reaches nothing on the table at [0.05, 0.1, 0.8]"),
    (MODEL, ROOM.replace('pos="0.05 0.1 0.4"', 'pos="0.05 0.1 4"'), "m from its shoulder; expected at most 1 m"),
    (MODEL.replace("room", "hall"), ROOM, "hall.xml is missing"),
    (MODEL.replace("room", "../room"), ROOM, "is outside of the folder"),
    (MODEL, ROOM.replace('"floor"', '"ground"'), "it has no geom 'floor', which a workspace needs"),
    (MODEL, ROOM.replace('"table_top"', '"top"'), "it has no site 'table_top', which a workspace needs"),
    (MODEL, ROOM.replace("<site", '<joint name="hinge"/><site'), "it has a joint, 'hinge'; what moves is a fixture"),
    (MODEL, ROOM.replace('"box"', '"bx"'), "room.xml:6: "),
])  # fmt: skip
def test_what_is_wrong_with_a_workspace_is_one_line(bench, text, room, message):
    bench(text, room)
    with pytest.raises(LiberoError) as caught:
        LiberoEnv(task(), cameras=())
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("perturb", ["table=0.5", "camera=0.2,background=0.5@step3"])
def test_surfaces_of_a_room_of_ones_own_are_not_replaced(bench, closing, perturb):
    bench(TABLE)
    closing(LiberoEnv(task(), cameras=(), perturb=perturb))
    bench(MODEL)
    with pytest.raises(InvalidInputError, match="bench has no material (floor|wall) of this package"):
        LiberoEnv(task(), cameras=(), perturb=perturb)


def test_a_file_of_any_size_beside_a_workspace_is_named(bench):
    folder = bench(TABLE)
    with open(folder / "sparse.bin", "wb") as file:
        file.truncate(200 << 30)
    with pytest.raises(LiberoError, match=r"sparse\.bin: it is larger than 256 MiB"):
        task()


def test_a_task_without_its_workspace_is_refused(bench, objects_home):
    folder = bench(TABLE)
    made = task()
    (folder / "workspace.yaml").unlink()
    with pytest.raises(UnknownNameError, match=r"unknown workspace among the fixtures \['bench'\]"):
        LiberoEnv(made, cameras=())


@pytest.mark.parametrize("name", ["kitchen_table", "kitchen", "kitchen_scene1"])
def test_a_workspace_with_the_name_of_a_scene_of_the_benchmark_is_refused(bench, name):
    folder = bench(TABLE)
    folder.rename(folder.with_name(name))
    with pytest.raises(LiberoError, match=f"{name} is a scene of the benchmark and a workspace of yours"):
        task(scene=name)
