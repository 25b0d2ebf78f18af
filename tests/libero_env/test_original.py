"""The original's assets: physics as measured_objects from the original, rooms as it had them, level of detail."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from libero_env import BatchEnv, make_task
from libero_env.assets.arena import load_workspace
from libero_env.assets.original import OriginalPack, is_original
from libero_env.assets.original_arena import TEXTURES
from libero_env.assets.pack import BuiltinPack, problems
from libero_env.assets.published import check_folder
from libero_env.assets.simplify import decimate
from libero_env.demos.stored_model import compile_stored, model_xml, spec_without_textures
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects import ObjectModel, register_object
from libero_env.objects.catalog import _registered
from libero_env.sim.scene_spec import scene_spec
from libero_env.tasks import get_task
from libero_env.workspaces import WORKSPACES
from tests.harness.models import bounds

pytestmark = pytest.mark.sim

_TYPES = {"sphere": 2, "capsule": 3, "ellipsoid": 4, "cylinder": 5, "box": 6, "mesh": 7}
# The measurements took "window_" and "faucet_" for the prefix of the instance.
_CUT = {"window": {"slide": "window_slide"}, "faucet": {"link2": "faucet_link2"}}


@pytest.fixture(scope="module")
def pack(shared):
    return OriginalPack(str(shared / "official" / "assets"))


@pytest.fixture(scope="module")
def compiled(pack):
    def compile_one(category):
        if category not in cache:
            cache[category] = pack.build(category).spec.compile()
        return cache[category]

    cache: dict[str, mujoco.MjModel] = {}
    return compile_one


def test_the_folder_is_recognised(shared, tmp_path):
    assert is_original(shared / "official" / "assets") and not is_original(tmp_path)


def test_all_that_the_original_could_build_is_there(pack, measured_objects):
    assert set(pack.categories()) == {name for name, found in measured_objects.items() if "mass" in found}


def test_masses(pack, measured_objects, compiled):
    for category in pack.categories():
        names = _CUT.get(category, {})
        for body in measured_objects[category]["bodies"]:
            mass = compiled(category).body(names.get(body["name"], body["name"])).mass[0]
            assert mass == pytest.approx(body["mass"], abs=6e-6), (category, body["name"])


def test_joints_are_in_order_and_move_the_same_way(pack, measured_objects, compiled):
    for category in pack.categories():
        model, names = compiled(category), _CUT.get(category, {})
        expected = [joint for joint in measured_objects[category]["joints"] if joint["type"] != "free"]
        ours = [model.joint(j).name for j in range(model.njnt)]
        assert ours == [names.get(j["name"], j["name"]) for j in expected]
        for found, joint in zip(map(model.joint, range(model.njnt)), expected, strict=True):
            np.testing.assert_allclose(found.range, joint["range"], atol=1e-5)
            np.testing.assert_allclose(found.axis, joint["axis"], atol=1e-4)
            assert found.frictionloss[0] == pytest.approx(joint["frictionloss"])
            assert found.armature[0] == pytest.approx(joint["armature"])
            assert np.ravel(found.damping)[0] == pytest.approx(joint["damping"])


def test_sites_are_where_regions_expect_them(pack, measured_objects, compiled):
    for category in pack.categories():
        model, sites = compiled(category), measured_objects[category]["sites"]
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        assert [model.site(s).name for s in range(model.nsite)] == [site["name"] for site in sites]
        for i, site in enumerate(sites):
            np.testing.assert_allclose(data.site_xpos[i], site["pos"], atol=2e-5, err_msg=category)
            np.testing.assert_allclose(data.site_xmat[i], site["xmat"], atol=2e-4, err_msg=category)
            used = {"box": 3, "cylinder": 2, "sphere": 1}.get(site["type"], 3)
            np.testing.assert_allclose(model.site_size[i][:used], site["size"][:used], atol=2e-5)


def test_collision_geoms(pack, measured_objects, compiled):
    for category in pack.categories():
        model = compiled(category)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        solid = np.flatnonzero((model.geom_contype | model.geom_conaffinity) > 0)
        expected = measured_objects[category]["collision_geoms"]
        assert len(solid) == len(expected), category
        for geom, found in zip(solid, expected, strict=True):
            np.testing.assert_allclose(data.geom_xpos[geom], found["pos"], atol=3e-5, err_msg=category)
            np.testing.assert_allclose(model.geom_friction[geom], found["friction"], err_msg=category)
            assert model.geom_type[geom] == _TYPES[found["type"]]


def test_visual_geoms_weigh_nothing_and_collision_geoms_are_hidden(pack, compiled):
    for category in pack.categories():
        model = compiled(category)
        assert set(model.geom_group) <= {0, 1}, category
        meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        assert (model.geom_group[meshes] == 1).all(), category


def test_placement_figures_are_those_of_the_files(pack, measured_objects):
    for category in pack.categories():
        model, expected = pack.build(category), measured_objects[category]
        np.testing.assert_allclose(model.bottom_offset, expected["bottom_offset"], atol=1e-5)
        np.testing.assert_allclose(model.top_offset, expected["top_offset"], atol=1e-5)
        assert model.horizontal_radius == pytest.approx(expected["horizontal_radius"], abs=1e-5)


def test_the_builtin_pack_has_the_same_physics(pack, compiled):
    for category in pack.categories():
        original, builtin = compiled(category), BuiltinPack().build(category).spec.compile()
        names = [original.body(b).name for b in range(1, original.nbody) if original.body_mass[b] > 0]
        for name in names:
            ours, theirs = builtin.body(name), original.body(name)
            assert ours.mass[0] == pytest.approx(theirs.mass[0], rel=2e-3), (category, name)
            np.testing.assert_allclose(ours.inertia, theirs.inertia, rtol=2e-2, atol=1e-9, err_msg=category)
        for field in ("geom_friction", "geom_solimp", "geom_condim"):
            solid = [(m, (m.geom_contype | m.geom_conaffinity) > 0) for m in (original, builtin)]
            found = [np.unique(getattr(m, field)[collide], axis=0) for m, collide in solid]
            np.testing.assert_allclose(*found, err_msg=f"{category} {field}")


def test_instances_of_one_category_stand_side_by_side(pack):
    scene = mujoco.MjSpec()
    for instance in ("flat_stove_1", "flat_stove_2", "wooden_cabinet_1", "wooden_cabinet_2"):
        item = pack.build(instance.rpartition("_")[0])
        scene.attach(item.spec, prefix=f"{instance}_", frame=scene.worldbody.add_frame())
    model = scene.compile()
    assert model.body("wooden_cabinet_2_main").id > model.body("wooden_cabinet_1_main").id
    assert model.joint("flat_stove_2_button").range[1] == pytest.approx(2.1)


def test_each_build_is_fresh(pack):
    one, other = pack.build("milk"), pack.build("milk")
    one.spec.body("main").add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
    assert not list(other.spec.joints)


def test_unpublished_models_are_reported_as_missing(pack):
    for category in ("cherries", "corn", "mayo"):
        with pytest.raises(LiberoError, match=f"no model of '{category}'.*builtin"):
            pack.build(category)
    with pytest.raises(UnknownNameError, match="milk"):
        pack.build("milc")


def test_what_users_registered_comes_first(pack, monkeypatch):
    def mine() -> ObjectModel:
        spec = mujoco.MjSpec()
        spec.worldbody.add_body(name="main")
        return ObjectModel("milk", spec, horizontal_radius=0.123)

    monkeypatch.delitem(_registered, "milk", raising=False)
    register_object("milk", mine)
    try:
        assert pack.build("milk").horizontal_radius == BuiltinPack().build("milk").horizontal_radius == 0.123
    finally:
        del _registered["milk"]


def test_the_pack_is_complete(pack):
    absent = check_folder(Path(pack.root)).differences  # ../shared has fewer files than were published
    assert set(problems(pack)) == set(absent), "all objects and rooms compile"


# --- rooms ----------------------------------------------------------------------------------------------------------


def _room(pack, workspace, properties=None):
    spec = mujoco.MjSpec()
    pack.add_arena(spec, load_workspace(workspace), properties or {})
    return spec.compile()


@pytest.mark.parametrize("workspace", [name for name in WORKSPACES if name != "coffee_table"])
def test_rooms_are_the_original(pack, measured_workspaces, workspace):
    model = _room(pack, workspace)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    room = measured_workspaces[load_workspace(workspace).problem.lower()]
    assert model.ngeom == len(room["arena_geoms"])
    for geom, expected in enumerate(room["arena_geoms"]):
        assert model.geom(geom).name == expected["name"]
        assert model.body(model.geom_bodyid[geom]).name == expected["body"]
        assert bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) == expected["collides"]
        assert model.geom_group[geom] == expected["group"]
        if expected["type"] != "mesh":  # where the frame of a mesh lies depends on MuJoCo's version
            np.testing.assert_allclose(data.geom_xpos[geom], expected["pos_world"], atol=1e-4)
            np.testing.assert_allclose(model.geom_size[geom], expected["size"], atol=1e-4)
            np.testing.assert_allclose(model.geom_friction[geom], expected["friction"])
    cameras = {name: camera for name, camera in room["cameras"].items() if camera["body"] == "world"}
    assert {model.camera(c).name for c in range(model.ncam)} == set(cameras)
    assert {model.light(i).name for i in range(model.nlight)} == {light["name"] for light in room["lights"]}


def test_the_coffee_table_has_another_material_where_perturbations_say_so(pack):
    objects = {"objects": ["butter", "plate"], "place": {"butter_1": (0, 0.1), "plate_1": (0.05, 0.25)}}
    task = make_task(scene="coffee", goal="On butter_1 plate_1", language="serve the butter", **objects)
    with BatchEnv(task, 1, cameras=(), assets=pack, perturb="table=0.5") as env:
        env.reset(seed=0)
        assert [*env.perturbed.appearance(0).materials] == ["room_short_coffee_table"]


def test_every_style_has_its_picture(pack):
    for kind, names in TEXTURES.items():
        for name in names:
            assert _room(pack, "floor", {kind: name}).ntex == 3
    for scene in ("blue", "warm", "coffee"):
        for workspace in WORKSPACES:
            _room(pack, workspace, {"scene": scene})


# --- level of detail ------------------------------------------------------------------------------------------------


def test_level_of_detail_leaves_physics_alone(pack, shared, tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path))
    whole, light = (one.build("milk").spec.compile() for one in (pack, OriginalPack(pack.root, 300)))
    assert whole.nmeshface > 10_000 and light.nmeshface <= 320
    assert light.nmeshtexcoord > 0
    np.testing.assert_array_equal(whole.body_mass, light.body_mass)
    np.testing.assert_array_equal(whole.body_inertia, light.body_inertia)
    solid = whole.geom_group == 0
    for name in ("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref", "geom_solimp"):
        np.testing.assert_array_equal(getattr(whole, name)[solid], getattr(light, name)[solid])
    assert list(tmp_path.rglob("lod-*.npz"))
    meshes = [np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[:1] for m in (whole, light)]
    np.testing.assert_allclose(bounds(whole, meshes[0]), bounds(light, meshes[1]), atol=2e-3)


def test_simplifying_keeps_the_picture_in_place():
    """A square grid that the texture covers as seen from above: the coordinates must still be those of the places."""
    side = np.linspace(0.0, 1.0, 21)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    vertices = np.stack([x, y, 0.02 * np.sin(9 * x)], axis=1)
    corner = np.array([i * 21 + j for i in range(20) for j in range(20)])
    halves = ((0, 1, 22), (0, 22, 21))
    triangles = np.concatenate([corner[:, None] + np.array(half) for half in halves])
    points, faces, texcoords, indices = decimate(vertices, triangles, vertices[:, :2], triangles, 100)
    assert len(faces) <= 120 < len(triangles)
    np.testing.assert_allclose(texcoords[indices], points[faces][:, :, :2], atol=0.06)


def test_a_scene_is_written_without_textures_and_read_again(pack):
    problem = get_task("libero_goal/3").problem
    xml = model_xml(spec_without_textures(problem, pack), {})
    assert "<texture" not in xml and "<mesh" in xml
    whole = compile_stored(xml, scene_spec(problem, pack))
    scene = scene_spec(problem, pack).compile()
    assert (whole.ntex > 0, whole.nbody, whole.ngeom) == (True, scene.nbody, scene.ngeom)
