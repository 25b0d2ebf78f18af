"""Workspaces: the original's parameters, and visuals that stay light."""

from itertools import product

import mujoco
import numpy as np
import pytest

from libero_env.assets.arena import add_arena, add_mount, load_workspace, workspace_of_problem
from libero_env.assets.furnishing import load_styles, make_texture
from libero_env.errors import InvalidInputError
from libero_env.tasks import bddl
from libero_env.workspaces import WORKSPACES

pytestmark = pytest.mark.sim

MEASURED = {  # fixture category -> its entry in the original's figures
    "floor": "libero_floor_manipulation",
    "table": "libero_tabletop_manipulation",
    "kitchen_table": "libero_kitchen_tabletop_manipulation",
    "living_room_table": "libero_living_room_tabletop_manipulation",
    "study_table": "libero_study_tabletop_manipulation",
}


def compiled(category, properties=None, mount=False):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arena(spec, load_workspace(category), properties or {})
    if mount:
        add_mount(spec, load_workspace(category))
    return spec.compile()


def collides(model, geom):
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


@pytest.fixture(params=MEASURED)
def measured(request, measured_workspaces):
    return request.param, measured_workspaces[MEASURED[request.param]]


def test_collision_geometry_is_the_originals(measured):
    category, figures = measured
    model = compiled(category)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mine = [g for g in range(model.ngeom) if collides(model, g)]
    wanted = [g for g in figures["arena_geoms"] if g["collides"]]
    assert len(mine) == len(wanted)
    for geom in wanted:
        at = np.linalg.norm(data.geom_xpos[mine] - geom["pos_world"], axis=1) + np.linalg.norm(
            model.geom_size[mine] - geom["size"], axis=1
        )
        g = mine[int(at.argmin())]
        assert model.geom(g).name == geom["name"]
        assert model.body(int(model.geom_bodyid[g])).name == geom["body"]
        np.testing.assert_allclose(data.geom_xpos[g], geom["pos_world"], atol=1e-4)
        np.testing.assert_allclose(model.geom_size[g], geom["size"], atol=1e-4)
        np.testing.assert_allclose(model.geom_friction[g], geom["friction"], atol=1e-6)
        assert model.geom_group[g] == geom["group"]


def test_named_visuals_are_where_the_originals_are(measured):
    category, figures = measured
    model = compiled(category)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = {model.geom(g).name for g in range(model.ngeom)}
    for geom in figures["arena_geoms"]:
        if geom["type"] != "mesh" and geom["name"] and not geom["collides"]:
            assert geom["name"] in names
            np.testing.assert_allclose(data.geom(geom["name"]).xpos, geom["pos_world"], atol=1e-4)
            np.testing.assert_allclose(model.geom(geom["name"]).size, geom["size"], atol=1e-4)


def test_cameras_lights_and_robot_are_the_originals(measured):
    category, figures = measured
    model = compiled(category)
    fixed = {name: camera for name, camera in figures["cameras"].items() if camera["body"] == "world"}
    assert {model.camera(i).name for i in range(model.ncam)} == set(fixed)
    for name, camera in fixed.items():
        mine = model.camera(name)
        assert mine.fovy[0] == pytest.approx(camera["fovy"])
        np.testing.assert_allclose(mine.pos, camera["pos"], atol=1e-5)
        assert abs(mine.quat @ camera["quat_wxyz"]) == pytest.approx(1, abs=1e-5)
    lights = {light["name"]: light for light in figures["lights"]}
    assert {model.light(i).name for i in range(model.nlight)} == set(lights)
    for name, light in lights.items():
        mine = model.light(name)
        for key in ("pos", "dir", "diffuse", "specular"):
            np.testing.assert_allclose(getattr(mine, key), light[key], atol=1e-5)
        assert bool(mine.castshadow[0]) == light["castshadow"]
    np.testing.assert_allclose(load_workspace(category).robot_base_pos, figures["robot_base"]["pos_world"])


@pytest.mark.parametrize("category", WORKSPACES)
def test_objects_stand_on_the_surface(category):
    """A ray from above meets the table or the floor at the height that placement uses."""
    workspace, model = load_workspace(category), compiled(category)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    start = np.array([*workspace.offset[:2], 1.4])
    groups = np.array([1, int(category == "floor"), 0, 0, 0, 0], np.uint8)
    distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), groups, 1, -1, hit)
    assert start[2] - distance == pytest.approx(workspace.offset[2] + workspace.region_height, abs=1e-4)
    assert collides(model, hit[0])


@pytest.mark.parametrize("category", WORKSPACES)
def test_rooms_are_light(category):
    model = compiled(category, mount=True)
    drawn = model.geom_dataid[(model.geom_group == 1) & (model.geom_dataid >= 0)]
    assert model.mesh_facenum[drawn].sum() <= 2000
    assert model.ngeom <= 30
    assert model.ntexdata <= 500_000  # bytes


@pytest.mark.parametrize("category", WORKSPACES)
def test_every_style_compiles_and_changes_visuals_only(category):
    styles = load_styles()
    plain = compiled(category)
    solid = [plain.geom(g).name for g in range(plain.ngeom) if collides(plain, g)]
    seen = set()
    wanted = [{kind: name} for kind in styles for name in styles[kind]]
    for properties in [*wanted, {"floor_style": "dark", "wall_style": "white", "scene": "coffee"}]:
        model = compiled(category, properties)
        assert [model.geom(g).name for g in range(model.ngeom) if collides(model, g)] == solid
        seen.add(bytes(model.tex_data) + model.mat_rgba.tobytes())
    assert len(seen) >= len(styles["floor"]) + len(styles["wall"]) - 1


def test_two_styles_of_one_kind_are_refused():
    with pytest.raises(InvalidInputError, match="floor, floor_style: two are of one kind"):
        compiled("floor", {"floor": "dark", "floor_style": "wood-plank"})


def test_styles_differ_and_repeat_without_a_seam():
    styles = load_styles()
    shown = [s for kind in ("floor", "wall") for s in styles[kind].values() if s["pattern"] != "plain"]
    pictures = [make_texture(style) for style in shown]
    for a, b in product(range(len(shown)), repeat=2):
        assert a == b or not np.array_equal(pictures[a], pictures[b])
    for style, image in zip(shown, pictures, strict=True):
        np.testing.assert_array_equal(image, make_texture(style))
        if style["pattern"] in ("plaster", "marble", "linen"):
            step = lambda a, b: np.abs(a.astype(float) - b).mean()  # noqa: E731
            inside = max(step(image[i], image[i + 1]) for i in range(len(image) - 1))
            assert step(image[-1], image[0]) <= inside
        assert abs(image.mean((0, 1)) / 255 - style["colours"][0]).max() < 0.06, (
            "about the colour it is called by"
        )


def test_a_scene_gives_way_to_what_is_named():
    blue = compiled("table", {"scene": "blue"})
    same = compiled("table", {"scene": "warm", "floor": "white-marble", "wall": "light-blue"})
    assert bytes(blue.tex_data) == bytes(same.tex_data)
    assert compiled("floor", {"scene": "coffee"}).ngeom == compiled("floor").ngeom + 1, "seats"


def test_problems_and_workspaces_belong_together(shared):
    for category in WORKSPACES:
        problem = load_workspace(category).problem
        for spelling in (problem, problem.lower(), problem.upper()):
            assert workspace_of_problem(spelling).name == category
    for file in sorted((shared / "official/bddl_files").rglob("*.bddl"))[::13]:
        problem = bddl.parse(file.read_text())
        assert workspace_of_problem(problem.name).name in problem.fixtures.values()


def test_the_pedestal_stands_on_the_floor_under_the_arm():
    model = compiled("kitchen_table", mount=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = np.array(load_workspace("kitchen_table").robot_base_pos)
    np.testing.assert_allclose(data.body("mount0_base").xpos, base + [0, 0, 0.01], atol=1e-9)
    solid = {model.geom(g).name for g in range(model.ngeom) if collides(model, g)} - {
        "floor",
        "table_collision",
    }
    assert solid == {"mount0_controller_box_col", "mount0_pedestal_feet_col", "mount0_pedestal_col"}
    feet = model.geom("mount0_pedestal_feet_col")
    assert data.geom("mount0_pedestal_feet_col").xpos[2] - feet.size[2] == pytest.approx(0.0, abs=0.02)
    for category in ("floor", "living_room_table", "coffee_table"):
        assert load_workspace(category).mount is None
        assert compiled(category, mount=True).ngeom == compiled(category).ngeom
