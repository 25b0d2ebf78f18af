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

MEASURED = {  # fixture category -> its entry in the original's figures, before `_manipulation`
    "floor": "floor", "table": "tabletop", "kitchen_table": "kitchen_tabletop",
    "living_room_table": "living_room_tabletop", "study_table": "study_tabletop"
}  # fmt: skip


def compiled(category, properties=None, mount=False):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arena(spec, load_workspace(category), properties or {})
    if mount:
        add_mount(spec, load_workspace(category))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def solid(model):
    collides = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    return {model.geom(g).name: g for g in collides}


@pytest.fixture(params=MEASURED)
def measured(request, measured_workspaces):
    return request.param, measured_workspaces[f"libero_{MEASURED[request.param]}_manipulation"]


def test_collision_geometry_and_named_visuals_are_the_originals(measured):
    category, figures = measured
    model, data = compiled(category)
    mine = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    assert len(mine) == sum(geom["collides"] for geom in figures["arena_geoms"])
    for geom in figures["arena_geoms"]:
        if geom["collides"]:
            apart = [data.geom_xpos[mine] - geom["pos_world"], model.geom_size[mine] - geom["size"]]
            g = mine[int(np.linalg.norm(apart, axis=2).sum(axis=0).argmin())]
            assert model.geom(g).name == geom["name"] and model.geom_group[g] == geom["group"]
            assert model.body(int(model.geom_bodyid[g])).name == geom["body"]
            np.testing.assert_allclose(model.geom_friction[g], geom["friction"], atol=1e-6)
        elif geom["type"] != "mesh" and geom["name"]:
            g = model.geom(geom["name"]).id
        else:
            continue
        np.testing.assert_allclose(data.geom_xpos[g], geom["pos_world"], atol=1e-4)
        np.testing.assert_allclose(model.geom_size[g], geom["size"], atol=1e-4)


def test_cameras_lights_and_robot_are_the_originals(measured):
    category, figures = measured
    model, _ = compiled(category)
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
    workspace, (model, data), hit = load_workspace(category), compiled(category), np.zeros(1, np.int32)
    start = np.array([*workspace.offset[:2], 1.4])
    groups = np.array([1, int(category == "floor"), 0, 0, 0, 0], np.uint8)
    distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), groups, 1, -1, hit)
    assert start[2] - distance == pytest.approx(workspace.offset[2] + workspace.region_height, abs=1e-4)
    assert model.geom_contype[hit[0]] or model.geom_conaffinity[hit[0]]


@pytest.mark.parametrize("category", WORKSPACES)
def test_rooms_are_light(category):
    model, _ = compiled(category, mount=True)
    drawn = model.geom_dataid[(model.geom_group == 1) & (model.geom_dataid >= 0)]
    assert model.mesh_facenum[drawn].sum() <= 2000
    assert model.ngeom <= 30
    assert model.ntexdata <= 500_000  # bytes


@pytest.mark.parametrize("category", WORKSPACES)
def test_every_style_compiles_and_changes_visuals_only(category):
    styles, seen = load_styles(), set()
    plain, _ = compiled(category)
    wanted = [{kind: name} for kind in styles for name in styles[kind]]
    for properties in [*wanted, {"floor_style": "dark", "wall_style": "white", "scene": "coffee"}]:
        model, _ = compiled(category, properties)
        assert [*solid(model)] == [*solid(plain)]
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
        assert abs(image.mean((0, 1)) / 255 - style["colours"][0]).max() < 0.06, "the colour of its name"


def test_a_scene_gives_way_to_what_is_named():
    blue, _ = compiled("table", {"scene": "blue"})
    same, _ = compiled("table", {"scene": "warm", "floor": "white-marble", "wall": "light-blue"})
    assert bytes(blue.tex_data) == bytes(same.tex_data)
    assert compiled("floor", {"scene": "coffee"})[0].ngeom == compiled("floor")[0].ngeom + 1, "seats"


def test_problems_and_workspaces_belong_together(shared):
    for category in WORKSPACES:
        problem = load_workspace(category).problem
        for spelling in (problem, problem.lower(), problem.upper()):
            assert workspace_of_problem(spelling).name == category
    for file in sorted((shared / "official/bddl_files").rglob("*.bddl"))[::13]:
        problem = bddl.parse(file.read_text())
        assert workspace_of_problem(problem.name).name in problem.fixtures.values()


def test_the_pedestal_stands_on_the_floor_under_the_arm():
    model, data = compiled("kitchen_table", mount=True)
    base = np.array(load_workspace("kitchen_table").robot_base_pos)
    np.testing.assert_allclose(data.body("mount0_base").xpos, base + [0, 0, 0.01], atol=1e-9)
    feet = "mount0_pedestal_feet_col"
    mount = {"mount0_controller_box_col", feet, "mount0_pedestal_col"}
    assert solid(model).keys() - {"floor", "table_collision"} == mount
    assert data.geom(feet).xpos[2] - model.geom(feet).size[2] == pytest.approx(0.0, abs=0.02)
    for category in ("floor", "living_room_table", "coffee_table"):
        assert load_workspace(category).mount is None
        assert compiled(category, mount=True)[0].ngeom == compiled(category)[0].ngeom
