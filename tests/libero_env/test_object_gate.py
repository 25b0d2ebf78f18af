"""Object files from others: nothing is read or written outside of their folder, and nothing grows without bound."""

import json
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from PIL import Image

from libero_env.design.objects import add_object
from libero_env.errors import LiberoError
from libero_env.objects import folder, get_object
from libero_env.objects.mjcf import read_mjcf

pytestmark = pytest.mark.sim

BOX = '<geom type="box" size=".02 .02 .02" mass=".1"/>'
MESH = '<geom type="mesh" mesh="m"/>'
PAINT = '<material name="p" texture="t"/>'
PAINTED = '<geom type="box" size=".02 .02 .02" mass=".1" material="p"/>'


@pytest.fixture(autouse=True)
def home(objects_home) -> Path:
    """A folder `own` for the files of an object, and objects and caches beside it."""
    for name in ("own", "secret"):
        (objects_home / name).mkdir()
        trimesh.creation.box((0.04, 0.05, 0.06)).export(objects_home / name / "m.stl")
    return objects_home


def mjcf(home: Path, *, geom: str = BOX, assets: str = "", inside: str = "", around: str = "") -> Path:
    """An MJCF file with one body on line 3."""
    path = home / "own" / "thing.xml"
    path.write_text(
        f"<mujoco>{around}\n<asset>{assets}</asset>\n"
        f'<worldbody><body name="b">{geom}{inside}</body></worldbody></mujoco>'
    )
    return path


def png(width: int, height: int, data: bytes) -> bytes:
    """A PNG file with these bytes as its picture."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("name", ["../../victim/x", "{home}/victim/x", "a/b", "&quot;", "é", "..", "main"])
def test_names_of_assets_never_become_paths(home, name):
    name = name.format(home=home)
    (home / "victim").mkdir()
    (home / "victim" / "x_m.stl").write_text("precious")
    mesh = f'<mesh name="{name}" file="m.stl"/>'
    added = add_object(mjcf(home, assets=mesh, geom=f'<geom type="mesh" mesh="{name}"/>'))
    assert [path.read_text() for path in (home / "victim").iterdir()] == ["precious"]
    written = {path.name for path in added.folder.iterdir()}
    assert written == {"object.xml", "object.yaml", "preview.png", "mesh0_m.stl"}
    get_object("thing").spec.compile()


@pytest.mark.parametrize(("around", "assets"), [
    ("", '<mesh name="m" file="../secret/m.stl"/>'),
    ("", '<mesh name="m" file="{home}/secret/m.stl"/>'),
    ("", '<mesh name="m" file="C:\\secret\\m.stl"/>'),
    ("", '<mesh name="m" file="..\\secret\\m.stl"/>'),
    ("", '<mesh name="m" file="linked.stl"/>'),
    ("", '<mesh name="m" file="below/m.stl"/>'),
    ("", '<mesh name="m" file="file:///etc/passwd"/>'),
    ('<compiler meshdir="../secret"/>', '<mesh name="m" file="m.stl"/>'),
    ('<compiler assetdir="{home}/secret"/>', '<mesh name="m" file="m.stl"/>'),
    ('<include file="../secret/more.xml"/>', '<mesh name="m" file="m.stl"/>'),
])  # fmt: skip
def test_files_elsewhere_are_not_read(home, around, assets):
    (home / "own" / "linked.stl").symlink_to(home / "secret" / "m.stl")
    (home / "own" / "below").symlink_to(home / "secret")
    (home / "secret" / "more.xml").write_text("<mujoco/>")
    path = mjcf(home, geom=MESH, assets=assets.format(home=home), around=around.format(home=home))
    with pytest.raises(LiberoError, match=r"thing\.xml:[12]: .*outside of the folder") as caught:
        add_object(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(LiberoError, match="outside of the folder"):
        folder.read_spec(path)  # a stored object from somebody else


def test_files_in_the_folder_are_found_as_mujoco_finds_them(home):
    (home / "own" / "parts").mkdir()
    (home / "own" / "m.stl").rename(home / "own" / "parts" / "m.stl")
    (home / "own" / "more.xml").write_text('<mujoco><asset><mesh name="m" file="m.stl"/></asset></mujoco>')
    around = '<compiler meshdir="parts"/><include file="more.xml"/>'
    assert add_object(mjcf(home, geom=MESH, around=around)).properties["mass"] > 0
    stripped = '<compiler meshdir="parts" strippath="true"/>'
    path = mjcf(home, geom=MESH, around=stripped, assets='<mesh name="m" file="/home/me/m.stl"/>')
    assert read_mjcf(path).root.find("asset/mesh").get("file") == str(home / "own" / "parts" / "m.stl")


@pytest.mark.parametrize(("parts", "message"), [
    ({"inside": '<replicate count="300"><replicate count="300"><site/></replicate></replicate>'}, "90000"),
    ({"inside": "<body><joint/><geom size='.01'/></body>" * 101}, "101 elements <joint>; .* at most 100"),
    ({"inside": "<frame>" * 200 + "</frame>" * 200}, ":3: elements within elements, more than 80 deep"),
    ({"inside": '<composite type="cable" count="9 1 1"/>'}, ":3: <composite> in <body> is not used"),
    ({"geom": '<geom type="box" size=".02 .02 .02"><plugin/></geom>'}, "<plugin> in <geom> .* it has no elements"),
    ({"assets": '<mseh name="x" file="m.stl"/>'}, "Did you mean 'mesh'"),
    ({"assets": '<texture name="t" builtin="flat" width="8192" height="8192"/>'}, "width .* value 8192"),
    ({"assets": '<mesh name="m" vertex="nan 0 0 1 0 0 0 1 0 0 0 1"/>'}, "vertex of <mesh> has the value nan"),
    ({"geom": '<geom size="1e30"/>'}, "value 1e[+]30; expected numbers up to 10"),
    ({"geom": '<geom size="5"/>'}, "it reaches 5 m"),
    ({"geom": '<geom size="1.5" mass="1"/>' * 20}, "20 collision geoms have 45 m.2 in all"),
    ({"geom": '<geom size=".01"/>' * 1500}, "3000 geoms with their copies for display"),
    ({"geom": '<geom size=".02" mass="1e9"/>'}, "its mass is 1e[+]09 kg"),
    ({"geom": '<geom size=".02" rgba="red"/>'}, "rgba of <geom> is 'red'; expected numbers"),
    ({"geom": '<geom size=".02" group="1.5"/>'}, "group of <geom> is '1.5'; expected a whole number"),
    ({"geom": '<geom size=".02" typ="box"/>'}, "thing.xml:3: .*typ"),
    ({"around": '<equality><weld body1="b"/></equality>'}, ":1: <weld> fixes the object to the world"),
    ({"inside": '<body name="main"><geom size=".01"/></body>'}, "a part is named 'main'"),
    ({"around": '<!DOCTYPE x [<!ENTITY y "z">]>'}, ":1: "),
    ({"around": '<include file="thing.xml"/>'}, "included twice"),
    ({"geom": PAINTED, "assets": '<texture name="t" file="big.png"/>' + PAINT}, "big.png"),
    ({"geom": PAINTED, "assets": '<texture name="t" file="bomb.png"/>' + PAINT}, "bomb.png"),
    ({"geom": MESH, "assets": '<mesh name="m" file="short.stl"/>'}, "short.stl"),
    ({"geom": MESH, "assets": '<mesh name="m" file="empty.obj"/>'}, "is empty"),
    ({"geom": MESH, "assets": '<mesh name="m" file="nothing.obj"/>'}, "mesh .*nothing.obj is missing"),
    ({"geom": MESH, "assets": '<mesh name="m" file="wrong.msh"/>'}, "wrong.msh"),
    ({"geom": MESH, "assets": '<mesh name="m" file="polygon.obj"/>'}, "thing.xml:2: "),
])  # fmt: skip
def test_what_an_object_may_not_have_is_named_with_its_line(home, parts, message):
    own = home / "own"
    (own / "big.png").write_bytes(png(20000, 20000, zlib.compress(b"")))
    (own / "bomb.png").write_bytes(png(8, 8, zlib.compress(bytes(100 << 20))))
    (own / "short.stl").write_bytes((own / "m.stl").read_bytes()[:-3])
    (own / "empty.obj").touch()
    (own / "wrong.msh").write_bytes(struct.pack("<4i9f3i", 3, 0, 0, 1, *range(9), 0, 1, 3))
    (own / "polygon.obj").write_text("v 0 0 0\nf" + " 1" * 5000)
    start = time.monotonic()
    with pytest.raises(LiberoError, match=message) as caught:
        add_object(mjcf(home, **parts))
    assert "\n" not in str(caught.value) and time.monotonic() - start < 5
    assert not list((home / "objects").iterdir())


def test_what_belongs_to_a_scene_is_left_out(home):
    around = (
        '<option timestep="1e-300"/><size memory="100G" nkey="1000000000"/><visual/><custom><text name="a" data="b"/>'
        '</custom><keyframe><key/><key/></keyframe><actuator><motor joint="j"/></actuator><default><motor/></default>'
    )
    inside = '<body name="c"><joint name="j"/><geom size=".01"/><camera name="eye"/></body>'
    path = mjcf(home, around=around, inside=inside)
    added = add_object(path)
    assert "omitted are 4 elements around the object" in added.notes[0]
    assert get_object("thing").spec.compile().nkey == 0


def test_parts_may_be_joined_and_keep_clear_of_each_other(home):
    inside = '<body name="c"><joint/><geom size=".01"/></body>'
    exclude, weld = '<exclude body1="b" body2="c"/>', '<weld body1="b" body2="c"/>'
    around = f"<contact>{exclude}</contact><equality>{weld}</equality>"
    add_object(mjcf(home, inside=inside, around=around))
    model = get_object("thing").spec.compile()
    assert (model.nexclude, model.neq) == (1, 1)


def test_geoms_get_names_that_are_free(home):
    added = add_object(mjcf(home, inside='<geom name="g0" size=".01"/><geom size=".01"/>'))
    assert added.properties["collision"]["pieces"] == 3
    assert {geom.name for geom in get_object("thing").spec.geoms if geom.group == 0} == {"g0", "g1", "g2"}


# --- meshes ---------------------------------------------------------------------------------------------------------


def obj(home: Path, *lines: str, materials: str = "") -> Path:
    """An OBJ file of a box, with these lines before it."""
    path = home / "own" / "box.obj"
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    text = [*lines, *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    text += ["vt 0 0", "vt 1 0", "vt 1 1", "usemtl q"]
    text += [f"f {a}/1 {b}/2 {c}/3" for a, b, c in mesh.faces + 1]
    path.write_text("\n".join(text) + "\n")
    path.with_name("box.mtl").write_text(f"newmtl q\n{materials}\n")
    return path


def gltf(home: Path, change: Callable[[dict], object]) -> Path:
    """A glTF file of a box, changed."""
    exported = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box((0.04, 0.05, 0.06))))
    for name, data in exported.items():
        (home / "own" / name).write_bytes(data)
    path = home / "own" / "model.gltf"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def test_a_gltf_file_with_its_files_is_read(home):
    assert add_object(gltf(home, lambda content: None), name="thing").properties["watertight"]


@pytest.mark.parametrize(("line", "materials", "message"), [
    ("mtllib ../secret/s.mtl", "", r"box\.obj: .*s\.mtl' is outside of the folder"),
    ("mtllib {home}/secret/s.mtl", "", "outside of the folder"),
    ("mtllib box.mtl", "map_Kd ../secret/s.png", r"box\.obj: .*s\.png' is outside of the folder"),
    ("mtllib box.mtl", "map_Kd {home}/secret/s.png", "outside of the folder"),
    ("mtllib box.mtl", "map_Kd linked.png", "outside of the folder"),
    ("mtllib box.mtl", "map_Kd -s 1 1 1 nothing.png", "nothing.png is missing"),
    ("mtllib box.mtl", "map_Kd noise.png", "not a picture"),
    ("mtllib box.mtl", "map_Kd big.png", "400000000 pixels"),
    ("mtllib box.mtl", "map_Kd short.png", "image file is truncated"),
    ("mtllib box.mtl", "map_Kd script.eps", "not a picture"),
    ('mtllib a"b', "", 'a"b is missing'),
    ("v nan 0 0", "", "not finite"),
    ("v 1e400 0 0", "", "not finite"),
    ("f 1 2 99999", "", "cannot be read"),
    ("f 1 2 3\n" * 1_000_001, "", "1000013 triangles; simplify it to 1000000"),
])  # fmt: skip
def test_meshes_name_files_of_their_folder_and_hold_what_is_usual(home, line, materials, message):
    own, secret = home / "own", home / "secret"
    for place in (own / "short.png", secret / "s.png"):
        Image.new("RGB", (64, 64)).save(place)
    (own / "short.png").write_bytes((own / "short.png").read_bytes()[:60])
    (secret / "s.mtl").write_text("newmtl q\nKd 1 0 0\n")
    (own / "linked.png").symlink_to(secret / "s.png")
    (own / "noise.png").write_bytes(b"noise")
    (own / "script.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    (own / "big.png").write_bytes(png(20000, 20000, zlib.compress(b"")))
    path = obj(home, line.format(home=home), materials=materials.format(home=home))
    with pytest.raises(LiberoError, match=message) as caught:
        add_object(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("change", "message"), [
    (lambda g: g["buffers"][0].update(uri="%2e%2e/secret/x.bin"), "outside of the folder"),
    (lambda g: g["buffers"][0].update(uri="http://127.0.0.1/x.bin"), "outside of the folder"),
    (lambda g: g.update(images=[{"uri": "file:///etc/passwd"}]), "outside of the folder"),
    (lambda g: g.update(images=[{"uri": "nothing.png"}]), "nothing.png is missing"),
    (lambda g: g.update(images=3), "cannot be read"),
    (lambda g: g.update(images=[{"uri": 7}]), r"images\[0\].uri is 7; expected the name of a file"),
    (lambda g: g["accessors"][0].update(count=10**9), "cannot be read"),
    (lambda g: g["accessors"][0].update(count=-1), "cannot be read"),
    (lambda g: g["nodes"][0].update(children=[1, 1]), "cannot be read"),
    (lambda g: g.clear(), "cannot be read|no triangles"),
])  # fmt: skip
def test_gltf_files_likewise(home, change, message):
    with pytest.raises(LiberoError, match=message) as caught:
        add_object(gltf(home, change), name="thing")
    assert "\n" not in str(caught.value)


NUMBERED = b'{"asset": {"version": "2.0"}, "images": [{"uri": 7}], "scenes": [{}]}  '


@pytest.mark.parametrize(("name", "data", "message"), [
    ("a.stl", bytes(80) + struct.pack("<I", 2**31) + bytes(50), "no triangles|cannot be read"),
    ("a.stl", bytes(80) + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0), "not finite"),
    ("a.stl", b"solid x\nfacet normal 0 0 1\nouter loop\nvertex nan 0 0\n", "no triangles"),
    ("a.stl", b"", "is empty"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 2000000000\nend_header\n", "cannot be read"),
    ("a.ply", b"ply\nformat ascii 1.0\ncomment TextureFile ../secret/s.png\nend_header\n", "outside of the folder"),
    ("a.glb", b"glTF" + bytes(60), "cannot be read"),
    ("a.glb", b"glTF" + struct.pack("<III", 2, 20 + len(NUMBERED), len(NUMBERED)) + b"JSON" + NUMBERED, "uri is 7"),
    ("a.gltf", b"[" * 100_000, "cannot be read"),
    ("a.gltf", b"\xff\xfe", "cannot be read"),
])  # fmt: skip
def test_other_formats_likewise(home, name, data, message):
    (home / "own" / name).write_bytes(data)
    with pytest.raises(LiberoError, match=message) as caught:
        add_object(home / "own" / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("options", "message"), [
    ({"size": float("nan")}, "size is nan"),
    ({"size": 1e-300}, "size is 1e-300; expected greater than or equal to 0.001"),
    ({"mass": 1.0, "density": 2.0}, "give only one of them"),
    ({"name": "../x"}, "not a valid name"),
    ({"name": "class"}, "reserved word"),
])  # fmt: skip
def test_options_are_checked_before_anything_is_made(home, options, message):
    with pytest.raises(LiberoError, match=message):
        add_object(home / "own" / "m.stl", **options)
    assert not (home / "objects").exists() or not list((home / "objects").iterdir())


def test_an_objects_folder_that_is_a_file_is_named(home):
    with pytest.raises(LiberoError, match=r"m\.stl.*not a folder|m\.stl.*exists"):
        add_object(home / "own" / "m.stl", out=home / "own" / "m.stl")
