"""Objects made of mesh and MJCF files: what becomes of them, where they are kept, and what is refused."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from libero_cli.main import main
from libero_env.demos.config import DemoConfig
from libero_env.design.objects import add_object, register_object_file
from libero_env.design.objects.collision import boxes_of, collision_pieces, is_closed, volume_filled
from libero_env.design.objects.mesh_file import bounds, read_mesh
from libero_env.design.objects.mesh_object import DENSITY, merge_vertices
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.objects import folder, get_object, object_names
from libero_env.sim.scene import build_scene
from libero_env.tasks import make_task
from libero_env.tasks.merging import model_regions

pytestmark = [pytest.mark.sim, pytest.mark.usefixtures("objects_home")]

DOOR = """<mujoco><compiler angle="radian"/>
  <default><default class="look"><geom contype="0" conaffinity="0" group="2" mass="0"/></default></default>
  <asset><mesh name="m" file="meshes/box.stl"/><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody><light pos="0 0 2"/><body name="chest" pos="1 2 3"><freejoint/>
    <geom type="box" size="0.03 0.03 0.02" mass="0.2"/>
    <geom type="mesh" mesh="m" material="red" class="look"/>
    <body name="lid" pos="0 0 0.025"><joint name="hinge" axis="0 1 0" range="0 1.5"/>
      <geom type="box" size="0.03 0.03 0.004" mass="0.05"/><site name="lid_site" size="0.01"/></body>
  </body></worldbody></mujoco>"""
ORIGINAL = """<mujoco><worldbody><body>
  <body name="object"><geom type="box" size="0.02 0.02 0.03" mass="0.05" group="0"/>
    <geom type="box" size="0.02 0.02 0.03" rgba="0.9 0.1 0.1 1" group="1" contype="0" conaffinity="0"/></body>
  <site name="bottom_site" pos="0 0 -0.03"/></body></worldbody></mujoco>"""


def box(path: Path, extents=(0.04, 0.05, 0.06)) -> Path:
    trimesh.creation.box(extents).export(path)
    return path


def textured_box(path: Path) -> Path:
    """An OBJ file of two materials, one of them a picture: left half red, right half blue."""
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    picture = Image.new("RGB", (16, 16), (255, 0, 0))
    picture.paste((0, 0, 255), (8, 0, 16, 16))
    picture.save(path.with_name("skin.png"))
    path.with_suffix(".mtl").write_text("newmtl skin\nmap_Kd skin.png\nnewmtl green\nKd 0 1 0\n")
    lines = [f"mtllib {path.stem}.mtl", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "usemtl skin"]
    for number, (a, b, c) in enumerate(mesh.faces + 1):
        lines += ["usemtl green"] * (number == 8) + [f"f {a}/1 {b}/2 {c}/3"]
    path.write_text("\n".join(lines) + "\n")
    return path


def cup() -> trimesh.Trimesh:
    """Hollow: 7 cm wide, 9 cm high, walls of 3 mm."""
    profile = [[0, 0], [0.03, 0], [0.035, 0.09], [0.032, 0.09], [0.027, 0.004], [0, 0.004]]
    return trimesh.creation.revolve(np.array(profile), sections=24)


def task_with(name: str):
    """A task in the kitchen with an object of that name."""
    return make_task(
        scene="kitchen", objects=[name], place={name: (0, 0)}, goal=f"Up {name}_1", language="lift it"
    )


def test_a_textured_mesh_becomes_an_object_of_a_scene(tmp_path):
    added = add_object(textured_box(tmp_path / "my box.obj"), size=0.12, density=500.0)
    assert (added.name, added.folder) == ("my_box", tmp_path / "objects" / "my_box")
    assert added.properties["size"] == pytest.approx([0.08, 0.10, 0.12])
    mass = 0.08 * 0.10 * 0.12 * 500
    assert added.properties["mass"] == pytest.approx(mass, rel=1e-4)
    assert added.properties["stands"]
    assert added.properties["collision"] == {"method": "hull", "pieces": 1}
    grasp = added.properties["grasp"]
    assert grasp["width"] is None and "too far apart" in grasp["reason"]
    with Image.open(added.folder / "preview.png") as opened:
        picture = np.asarray(opened)
    assert picture.shape == (2 * 224, 4 * 224, 3) and np.ptp(picture) > 100

    task = task_with("my_box")
    model = build_scene(task.problem).model
    body = model.body("my_box_1_main")
    assert model.body_mass[body.id] == pytest.approx(mass, rel=1e-4)
    sides = np.array([0.08, 0.10, 0.12]) ** 2
    moments = sorted(mass / 12 * (sides.sum() - sides))
    assert sorted(model.body_inertia[body.id]) == pytest.approx(moments, rel=1e-3)
    names = [model.texture(t).name for t in range(model.ntex)]
    (texture,) = (model.texture(name) for name in names if name.startswith("my_box_1_"))
    assert (texture.width[0], texture.height[0]) == (16, 16)
    looks = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body.id and model.geom_group[g] == 1]
    assert len(looks) == 2
    assert sorted(model.mat_rgba[model.geom_matid[looks]].tolist()) == [[0, 1, 0, 1], [1, 1, 1, 1]]


@pytest.mark.parametrize("ending", [".obj", ".stl", ".ply", ".glb"])
def test_every_format_gives_the_same_shape(tmp_path, ending):
    notes: list[str] = []
    surfaces = read_mesh(box(tmp_path / f"box{ending}"), size=None, up="z", notify=notes.append)
    low, high = bounds(surfaces)
    assert high - low == pytest.approx([0.04, 0.05, 0.06])
    assert low + high == pytest.approx([0, 0, 0], abs=1e-9)
    mesh = merge_vertices(surfaces)
    assert (len(mesh.vertices), len(mesh.faces), notes) == (8, 12, [])
    assert mesh.volume == pytest.approx(1.2e-4)


def test_y_is_up_where_the_format_specifies_it(tmp_path):
    sizes = {}
    for ending in (".glb", ".stl"):
        surfaces = read_mesh(box(tmp_path / f"box{ending}"), size=None, up=None, notify=print)
        sizes[ending] = np.subtract(*bounds(surfaces)[::-1])
    assert sizes[".stl"] == pytest.approx([0.04, 0.05, 0.06])
    assert sizes[".glb"] == pytest.approx([0.04, 0.06, 0.05])


@pytest.mark.parametrize(("scale", "unit"), [(1000, "millimetres"), (100, "centimetres"), (1, None)])
def test_units_are_guessed_and_reported(tmp_path, scale, unit):
    notes: list[str] = []
    path = box(tmp_path / "box.stl", np.array([0.04, 0.05, 0.08]) * scale)
    low, high = bounds(read_mesh(path, size=None, up=None, notify=notes.append))
    assert max(high - low) == pytest.approx(0.08)
    assert unit in notes[0] if unit else not notes


def test_closed_means_that_every_edge_has_two_sides():
    mesh = trimesh.creation.box()
    turned = mesh.faces.copy()
    turned[0] = turned[0][::-1]
    for faces, closed in ((mesh.faces, True), (mesh.faces[1:], False), (turned, False)):
        assert is_closed(trimesh.Trimesh(mesh.vertices, faces, process=False)) == closed


def test_mass_and_inertia_are_those_of_the_solid(tmp_path):
    mesh = cup()
    mesh.export(tmp_path / "cup.stl")
    add_object(tmp_path / "cup.stl", density=1000.0, collision="boxes")
    model = get_object("cup").spec.compile()
    assert model.body("main").mass[0] == pytest.approx(1000.0 * mesh.volume, rel=1e-4)
    centre = mesh.center_mass - mesh.bounds.mean(axis=0)
    assert model.body("main").ipos == pytest.approx(centre, abs=1e-5)
    moments = sorted(np.linalg.eigvalsh(1000.0 * mesh.moment_inertia))
    assert sorted(model.body("main").inertia) == pytest.approx(moments, rel=1e-3)


def inside_any(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (np.abs(points[:, None] - boxes[:, :3]) <= boxes[:, 3:] + 1e-9).all(axis=2).any(axis=1)


def test_boxes_cover_the_walls_and_leave_a_cup_hollow():
    mesh = cup()
    boxes = boxes_of(mesh)
    assert 4 < len(boxes) <= 60
    assert inside_any(boxes, mesh.vertices).all() and inside_any(boxes, mesh.triangles_center).all()
    assert not inside_any(boxes, np.array([[0, 0, 0.05], [0.01, 0, 0.08], [0, 0, 0.1]])).any()


def test_boxes_of_a_solid_have_no_hole():
    mesh = trimesh.creation.icosphere(2, 0.05)
    boxes = boxes_of(mesh)
    points = np.random.default_rng(0).uniform(-0.028, 0.028, (200, 3))
    assert inside_any(boxes, points).all()
    assert 8 * boxes[:, 3:].prod(axis=1).sum() < 1.5 * mesh.volume


def test_what_is_convex_is_its_hull_and_what_is_not_is_taken_apart(monkeypatch):
    solid, hollow = trimesh.creation.icosphere(2, 0.05), cup()
    assert collision_pieces(solid, "decompose", print).method == "hull"
    assert volume_filled(hollow) < 0.5
    seen: dict = {}

    def run_coacd(mesh, **options):
        seen.update(options, longest=np.ptp(mesh.vertices, axis=0).max())
        low = mesh.vertices[:, 2] < 0.5
        return [(mesh.vertices[low], None), (mesh.vertices[~low], None)]

    made = lambda vertices, faces: SimpleNamespace(vertices=vertices)  # noqa: E731
    fake = SimpleNamespace(run_coacd=run_coacd, set_log_level=print, Mesh=made)
    monkeypatch.setitem(sys.modules, "coacd", fake)
    found = collision_pieces(hollow, "decompose", print)
    assert (found.method, len(found), seen["seed"]) == ("decompose", 2, 0)
    assert seen["longest"] == pytest.approx(1.0)  # its threshold is for meshes of that size
    assert np.ptp(np.concatenate(found.meshes), axis=0) == pytest.approx(np.ptp(hollow.vertices, axis=0))


def test_without_coacd_boxes_are_used_and_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    notes: list[str] = []
    mesh = cup()
    found = collision_pieces(mesh, "decompose", notes.append)
    assert found.method == "boxes" and "libero-lifelong[objects]" in notes[0]


def test_coacd_itself():
    pytest.importorskip("coacd")
    mesh = cup()
    found = collision_pieces(mesh, "decompose", print)
    assert found.method == "decompose" and 3 < len(found) <= 24
    centre = np.array([0, 0, 0.05])
    assert not any((p.min(axis=0) < centre).all() and (p.max(axis=0) > centre).all() for p in found.meshes)


def test_an_open_mesh_weighs_as_much_as_its_hull(tmp_path):
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    mesh.update_faces(np.arange(12) > 1)
    mesh.export(tmp_path / "open.stl")
    added = add_object(tmp_path / "open.stl", collision="hull", container=True)
    assert any("not watertight" in note for note in added.notes)
    assert added.properties["mass"] == pytest.approx(1.2e-4 * DENSITY, rel=1e-3)
    assert added.properties["grasp"]["width"] == pytest.approx(0.04, abs=0.003)
    assert model_regions("open") == ("contain_region",)


def test_an_mjcf_file_keeps_its_parts_and_gets_what_scenes_need(tmp_path):
    (tmp_path / "meshes").mkdir()
    box(tmp_path / "meshes" / "box.stl")
    (tmp_path / "chest.xml").write_text(DOOR)
    added = add_object(tmp_path / "chest.xml")
    assert added.properties["mass"] == pytest.approx(0.25)
    assert added.properties["size"][:2] == pytest.approx([0.06, 0.06])
    assert "1 elements around" in added.notes[0]
    item = get_object("chest")
    model = item.spec.compile()
    assert [model.joint(j).name for j in range(model.njnt)] == ["hinge"]
    assert model.body("main").pos.tolist() == [0, 0, 0]
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    assert solid.sum() == 2 and (model.geom_group[solid] == 0).all() and (model.geom_group[~solid] == 1).all()
    assert model_regions("chest") == ("lid_site",), "places, whatever their names end in"
    (tmp_path / "meshes" / "box.stl").unlink()  # the object has its own copy
    get_object("chest").spec.compile()


def test_a_file_of_the_originals_kind_is_read(tmp_path):
    (tmp_path / "brick.xml").write_text(ORIGINAL)
    added = add_object(tmp_path / "brick.xml", name="brick")
    assert added.properties["mass"] == pytest.approx(0.05)
    assert added.properties["bottom_offset"] == pytest.approx([0, 0, -0.03])
    assert get_object("brick").spec.compile().ngeom == 2


BODY = '<mujoco><worldbody><body name="b"{}>{}</body></worldbody></mujoco>'
SOLID = '<geom type="box" size=".02 .03 .05" mass=".1" rgba="1 0 0 1"/>'
STICKER = '<geom type="box" size=".01 .001 .01" pos="0 .031 0" contype="0" conaffinity="0" mass="0"{}/>'


@pytest.mark.parametrize(("group", "seen"), [("", 2), (' group="1"', 1)])
def test_solid_geoms_that_are_seen_beside_visual_ones_stay_seen(tmp_path, group, seen):
    (tmp_path / "b.xml").write_text(BODY.format("", SOLID + STICKER.format(group)))
    add_object(tmp_path / "b.xml")
    model = get_object("b").spec.compile()
    assert (model.geom_group == 1).sum() == seen


@pytest.mark.parametrize(("turned", "told"), [("", 0), (' euler="0 90 0"', 1)])
def test_a_rotation_that_is_omitted_is_told(tmp_path, turned, told):
    (tmp_path / "b.xml").write_text(BODY.format(turned, SOLID))
    notes = add_object(tmp_path / "b.xml").notes
    assert sum("the rotation of its root body is omitted" in note for note in notes) == told


def test_registering_lasts_for_the_process_and_is_made_once(tmp_path):
    path = box(tmp_path / "block.stl")
    assert register_object_file(path, mass=0.2) == "block"
    assert get_object("block").spec.compile().body("main").mass[0] == pytest.approx(0.2)
    made = list((tmp_path / "cache" / "objects").glob("*/block"))
    before = (made[0] / "object.xml").stat().st_mtime_ns
    register_object_file(path, mass=0.2)
    assert list((tmp_path / "cache" / "objects").glob("*/block")) == made
    assert (made[0] / "object.xml").stat().st_mtime_ns == before
    assert "block" in object_names() and folder.names() == ()


def test_the_texture_of_a_gltf_file_is_multiplied_by_its_factor(tmp_path):
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    white, uv = Image.new("RGB", (8, 8), (255, 255, 255)), np.zeros((len(mesh.vertices), 2))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=white, baseColorFactor=[255, 0, 0, 255])
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh.export(tmp_path / "red.glb")
    (material,) = get_object(register_object_file(tmp_path / "red.glb")).spec.materials
    assert material.rgba.tolist() == [1, 0, 0, 1] and any(material.textures)


def test_registering_again_reads_what_the_file_names(tmp_path):
    defaults = '<mujoco><default><default class="c"><geom type="box" size=".02 .02 %s"/></default></default></mujoco>'
    body = '<include file="sizes.xml"/><worldbody><body name="b"><geom class="c"/></body></worldbody>'
    (tmp_path / "block.xml").write_text(f"<mujoco>{body}</mujoco>")
    for height in (0.04, 0.06):
        (tmp_path / "sizes.xml").write_text(defaults % height)
        assert get_object(register_object_file(tmp_path / "block.xml")).top_offset[2] == height
    mesh, seen = textured_box(tmp_path / "box.obj"), []
    (picture,) = tmp_path.glob("*.png")
    for colour in ((250, 0, 0), (0, 0, 250)):
        Image.new("RGB", (8, 8), colour).save(picture)
        (texture,) = get_object(register_object_file(mesh)).spec.textures
        seen.append(Image.open(texture.file).convert("RGB").getpixel((0, 0)))
    assert seen == [(250, 0, 0), (0, 0, 250)]
    for turned in (False, True):
        shape = trimesh.creation.icosphere(subdivisions=1, radius=0.02)
        faces = shape.faces[:-4] if turned else shape.faces
        shape = trimesh.Trimesh(shape.vertices, faces, process=False)
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(shape)).items():
            (tmp_path / name).write_bytes(content)
        register_object_file(tmp_path / "model.gltf", mass=0.1)
    made = list((tmp_path / "cache" / "objects").glob("*/model"))
    assert len(made) == 2, "faces of a glTF file are in another"


@pytest.mark.parametrize("missing", [True, False])
def test_an_object_of_the_cache_that_is_damaged_is_made_again(tmp_path, caplog, missing):
    path = box(tmp_path / "block.stl")
    register_object_file(path, mass=0.2)
    (made,) = (tmp_path / "cache" / "objects").glob("*/block")
    (model,) = made.glob("object.xml")
    whole = model.read_bytes()
    model.write_bytes(whole + b"<!-- -->")
    if missing:
        model.unlink()
    register_object_file(path, mass=0.2)
    assert model.read_bytes() == whole
    assert len(caplog.messages) == 1 and caplog.messages[0].endswith("made again")


def test_what_is_kept_of_a_scene_depends_on_the_files(tmp_path):
    def digest() -> str:
        task = task_with("brick")
        assert build_scene(task.problem) is build_scene(task.problem)
        found = build_scene(task.problem).digest
        assert DemoConfig(task, (16, 16)).header()["own_models"] == found, "demonstrations are recorded again"
        return found

    (tmp_path / "brick.xml").write_text(ORIGINAL)
    place = add_object(tmp_path / "brick.xml").folder
    first = digest()
    text = (place / "object.xml").read_text()
    (place / "object.xml").write_text(text.replace("0.9 0.1 0.1", "0.1 0.9 0.1"))
    assert digest() != first
    second, properties = digest(), (place / "object.yaml").read_text()
    (place / "object.yaml").write_text(properties + "articulation: {open: [0.1, 0.2], close: [0, 0.05]}\n")
    assert digest() != second


def test_an_object_with_the_name_of_one_of_the_benchmark_is_refused(tmp_path):
    (tmp_path / "brick.xml").write_text(ORIGINAL)
    place = add_object(tmp_path / "brick.xml").folder
    place.rename(place.with_name("milk"))
    with pytest.raises(LiberoError, match="milk is an object of the benchmark and one of yours"):
        get_object("milk")


TWO = "<mujoco><worldbody>" + 2 * '<body><geom size=".02"/></body>' + "</worldbody></mujoco>"


@pytest.mark.parametrize(("file", "text", "options", "message"), [
    ("flat.obj", "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nf 1 2 3\n", {}, "it is flat"),
    ("empty.obj", "# nothing\n", {}, "empty.obj: "),
    ("two.xml", TWO, {}, "2 bodies"),
    ("weightless.xml", BODY.format("", '<geom size=".02" mass="0"/>'), {}, "has no mass"),
    ("xml.xml", "<mujoco>", {}, "xml.xml:1: not valid XML"),
    ("brick.xml", ORIGINAL, {"size": 0.1}, "defines size itself"),
    ("a.fbx", "", {}, "unknown format '.fbx'; valid: .xml"),
    ("large.stl", None, {"size": 3.0}, "too large"),
    ("large.stl", None, {"name": "milk"}, "--name my_milk"),
    ("large.stl", None, {"name": "Red Cup"}, "lower-case letters"),
    ("large.stl", None, {"collision": "cubes"}, "expected .decompose., .hull. or .boxes."),
])  # fmt: skip
def test_what_cannot_be_used_is_named_with_its_remedy(tmp_path, file, text, options, message):
    if text is None:
        box(tmp_path / file)
    else:
        (tmp_path / file).write_text(text)
    with pytest.raises(LiberoError, match=message):
        add_object(tmp_path / file, **options)
    root = tmp_path / "objects"
    assert not root.exists() or not list(root.iterdir())  # nothing half made stays


def test_a_stored_object_that_is_broken_is_named(tmp_path):
    (tmp_path / "brick.xml").write_text(ORIGINAL)
    place = add_object(tmp_path / "brick.xml").folder
    (place / "object.yaml").write_text("name: brick\n")
    with pytest.raises(LiberoError, match="bottom_offset is missing"):
        get_object("brick")


def test_replacing_removes_objects_only(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("all of it")
    with pytest.raises(InvalidInputError, match="notes is not the folder of an object"):
        add_object(box(tmp_path / "block.stl"), name="notes", out=tmp_path, replace=True)
    assert (tmp_path / "notes" / "thesis.txt").exists()


def test_the_mass_of_an_mjcf_file_is_that_of_its_groups_with_mass(tmp_path):
    path = tmp_path / "shell.xml"
    path.write_text("""<mujoco><compiler inertiagrouprange="0 0"/><worldbody><body name="b">
      <geom type="box" size="0.02 0.02 0.05" group="0" contype="0" conaffinity="0" density="500"/>
      <geom type="box" size="0.02 0.02 0.05" group="3" density="2000"/></body></worldbody></mujoco>""")
    added = add_object(path, out=tmp_path / "objects")
    model = mujoco.MjModel.from_xml_path(str(path))
    stored = folder.read_spec(added.folder / folder.MODEL).compile()
    assert added.properties["mass"] == pytest.approx(model.body_mass.sum()) == pytest.approx(0.08)
    np.testing.assert_allclose(stored.body_inertia[1], model.body_inertia[1])


def test_the_command_adds_lists_shows_renders_and_removes(tmp_path, capsys):
    path = str(box(tmp_path / "block.stl"))
    assert main(["objects", "add", path, "--name", "red_block", "--mass", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "4.0 x 5.0 x 6.0 cm" in said and "100 g" in said and "stands    yes" in said
    assert main(["objects", "add", path, "--name", "red_block"]) == 2
    assert "--replace" in capsys.readouterr().err
    task = task_with("red_block")
    before = task.digest
    assert main(["objects", "add", path, "--name", "red_block", "--mass", "0.2", "--replace"]) == 0
    assert "200 g" in capsys.readouterr().out
    assert task.digest != before, "results of the task with the old one are of another"
    assert main(["objects", "list"]) == 0 and capsys.readouterr().out.startswith("red_block ")
    assert main(["objects", "show", "red_block", "basket"]) == 0
    assert "contain_region" in capsys.readouterr().out
    model = folder.find("red_block") / folder.MODEL
    model.write_text(model.read_text().replace('mass="0.2"', 'mass="0.3"'))  # by hand
    assert main(["objects", "show", "red_block", "alphabet_soup", "wooden_cabinet"]) == 0
    own, can, cabinet = re.split(r"(?m)^\w+: .*$", capsys.readouterr().out)[1:]
    assert "300 g" in own and "6.0 x 6.0 x 7.6 cm" in can and "stands    yes" in can
    assert "21.8 cm" in cabinet and "open      from -0.16 to -0.14" in cabinet
    assert main(["objects", "preview", "basket", "--out", str(tmp_path / "basket.png")]) == 0
    with Image.open(tmp_path / "basket.png") as picture:
        assert picture.size == (4 * 224, 2 * 224)
    assert main(["objects", "remove", "red_block"]) == 0 and "red_block" not in object_names()
    capsys.readouterr()
    assert main(["objects", "remove", "red_block"]) == 2
    assert "user-defined object" in capsys.readouterr().err


def test_a_mesh_of_many_triangles_is_simplified(tmp_path):
    trimesh.creation.icosphere(4, 0.03).export(tmp_path / "ball.stl")
    added = add_object(tmp_path / "ball.stl", faces=300)
    model = mujoco.MjSpec.from_file(str(added.folder / "object.xml")).compile()
    assert model.mesh_facenum[model.mesh("ball_visual0_mesh").id] <= 330
    assert any("simplified" in note for note in added.notes)
