"""Object files of any kind: mutations of valid MJCF, OBJ, STL, PLY and glTF files."""

import copy
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from libero_env.design.objects import add_object
from libero_env.design.objects.mesh_file import read_mesh
from libero_env.design.objects.mjcf_file import store_mjcf
from libero_env.limited import limited_process
from libero_env.objects.folder import read_spec
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged

pytestmark = pytest.mark.sim

MODELS = [
    """<mujoco><compiler angle="radian" meshdir="parts"/><default><geom rgba="1 0 0 1"/>
    <default class="look"><geom contype="0" conaffinity="0" group="2" mass="0"/></default></default>
    <asset><mesh name="m" file="m.stl"/><texture name="t" type="2d" file="t.png"/>
    <material name="p" texture="t"/></asset>
    <worldbody><light pos="0 0 2"/><body name="chest" pos="1 2 3"><freejoint/>
    <geom type="box" size="0.03 0.03 0.02" mass="0.2"/><geom type="mesh" mesh="m" material="p" class="look"/>
    <replicate count="3" offset="0 0 0.01"><site size="0.01"/></replicate>
    <body name="lid" pos="0 0 0.025"><joint name="hinge" axis="0 1 0" range="0 1.5"/>
    <geom name="g1" type="box" size="0.03 0.03 0.004" mass="0.05"/><site name="lid_region" size="0.01"/></body>
    </body></worldbody><contact><exclude body1="chest" body2="lid"/></contact>
    <actuator><motor joint="hinge"/></actuator><keyframe><key qpos="0"/></keyframe></mujoco>""",
    """<mujoco><asset><mesh name="m" file="parts/m.obj" scale="0.5 0.5 0.5"/><texture name="t" builtin="checker"
    width="8" height="8" type="2d"/><material name="p" texture="t" texrepeat="2 2"/></asset><worldbody><body>
    <body name="object"><geom type="mesh" mesh="m" group="0"/><geom type="cylinder" size="0.02 0.03" rgba="1 0 0 1"
    group="1" contype="0" conaffinity="0" material="p"/><site name="inside" rgba="1 0 0 0"/></body>
    <site name="bottom_site" pos="0 0 -0.03"/></body></worldbody></mujoco>""",
    """<mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody><body name="b">
    <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/><geom type="mesh" mesh="m"/>
    <frame pos="0 0 .1"><geom type="capsule" fromto="0 0 0 0 0 .1" size=".01"/></frame>
    <body name="c"><joint name="j" type="slide" damping="1"/><geom type="ellipsoid" size=".01 .02 .03"/></body></body>
    </worldbody><equality><joint joint1="j" polycoef="0 1 0 0 0"/></equality>
    <tendon><fixed><joint joint="j" coef="1"/></fixed></tendon></mujoco>""",
]
VALUES = (
    "nan inf -inf 1e308 -1 0 1e-300 1e9 0.5 99999999999999999999 ../../secret/m.stl /etc/passwd parts/m.obj t.png x m "
    "p world main chest mesh plane hfield sdf box true false auto look object file:///etc/passwd parts/../m.stl é"
)
ODD_VALUES = ["", " ", "1 2", "1 2 3", "0 0 0", "0 0 0 0", "a b", "x" * 5000]
TAGS = (
    "body geom site joint freejoint inertial frame replicate composite flexcomp plugin attach include camera light "
    "mesh texture material hfield skin model default compiler option size asset worldbody weld connect pair exclude "
    "key general numeric mujoco"
)
KEYS = (
    "name class childclass file meshdir assetdir strippath type size pos quat euler mass density count offset group "
    "mesh material texture builtin params width height vertex face scale inertia range axis rgba fromto mocap limited "
    "angle inertiafromgeom solref solimp condim contype friction diaginertia fullinertia body1 body2 maxhullvert "
    "refpos coordinate autolimits boundmass settotalmass eulerseq fusestatic discardvisual nchannel gridlayout"
)
STEP = st.tuples(
    st.sampled_from(["set", "drop", "remove", "copy", "tag", "add"]),
    st.integers(0, 200),
    st.sampled_from(KEYS.split()),
    st.sampled_from([*VALUES.split(), *ODD_VALUES]),
    st.sampled_from(TAGS.split()),
)


def mutate(text: str, steps) -> bytes:
    root = ET.fromstring(text)
    for kind, where, key, value, tag in steps:
        nodes = list(root.iter())
        node = nodes[where % len(nodes)]
        if kind == "set":
            known = list(node.attrib) or [key]
            node.set(known[where % len(known)] if where % 3 else key, value)
        elif kind == "drop" and node.attrib:
            node.attrib.pop(list(node.attrib)[where % len(node.attrib)])
        elif kind == "remove" and len(node):
            node.remove(node[where % len(node)])
        elif kind == "copy" and len(node):
            node.append(copy.deepcopy(node[where % len(node)]))
        elif kind == "tag":
            node.tag = tag
        elif kind == "add":
            ET.SubElement(node, tag, {key: value})
    return ET.tostring(root)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with what the models name, `secret` beside it."""
    root = tmp_path_factory.mktemp("objects")
    patch = pytest.MonkeyPatch()
    patch.setenv("LIBERO_OBJECTS", str(root / "stored"))
    patch.setenv("LIBERO_CACHE", str(root / "cache"))
    box = trimesh.creation.box((0.04, 0.05, 0.06))
    for folder in ("own/parts", "secret", "out"):
        (root / folder).mkdir(parents=True)
    for name in ("own/parts/m.stl", "own/parts/m.obj", "secret/m.stl"):
        box.export(root / name)
    Image.new("RGB", (8, 8)).save(root / "own" / "parts" / "t.png")
    with limited_process():
        yield root
    patch.undo()


def seen(place: Path) -> dict[str, int]:
    """Everything except for what a test may change."""
    mine = {place / "own", place / "out", place / "stored", place / "cache"}
    return {
        str(path): path.stat().st_mtime_ns
        for path in place.rglob("*")
        if path.is_file() and not mine & {*path.parents}
    }


def convert(place: Path, path: Path, whole: bool) -> None:
    """Convert a file as `libero objects add` does; without `whole`, the object is not tested."""
    shutil.rmtree(place / "out")
    (place / "out").mkdir()
    before = seen(place)
    try:
        if whole:
            add_object(path, name="thing", replace=True)
        elif path.suffix == ".xml":
            store_mjcf(path, "thing", place / "out", container=True, notify=lambda _: None)
            read_spec(place / "out" / "object.xml").compile()
        else:
            read_mesh(path, size=0.06, up=None, notify=lambda _: None)
    finally:
        assert seen(place) == before, "a file outside was written"
        assert all(one.parent == place / "out" for one in (place / "out").rglob("*"))


@given(st.sampled_from(MODELS), st.lists(STEP, max_size=4), st.data(), st.integers(0, 39))
@examples(short=80, long=1500)
def test_mutations_of_models_are_converted_or_refused(place, model, steps, data, share):
    text = mutate(model, steps)
    if share % 5 == 0:
        text = data.draw(damaged(text))
    path = place / "own" / "model.xml"
    path.write_bytes(text)
    survive("object files", lambda: convert(place, path, whole=share == 0))


@given(st.sampled_from(["obj", "stl", "ply", "glb", "gltf"]), st.data(), st.integers(0, 39))
@examples(short=80, long=1500)
def test_mutations_of_meshes_are_converted_or_refused(place, kind, data, share):
    mesh = trimesh.creation.box((0.04, 0.05, 0.06)) if share % 2 else trimesh.creation.icosphere(1, 0.03)
    if kind == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (place / "own" / name).write_bytes(content)
        text = (place / "own" / "model.gltf").read_bytes()
    else:
        exported = mesh.export(file_type=kind)
        text = exported.encode() if isinstance(exported, str) else exported
    path = place / "own" / f"model.{kind}"
    path.write_bytes(data.draw(damaged(text)))
    survive("object files", lambda: convert(place, path, whole=share == 0))


@given(st.sampled_from(["m.stl", "m.obj", "t.png"]), st.data())
@examples(short=40, long=1000)
def test_mutations_of_the_files_of_models_are_converted_or_refused(place, name, data):
    model, whole = MODELS[name == "m.obj"], place / "own" / "parts" / name
    before = whole.read_bytes()
    (place / "own" / "model.xml").write_text(model)
    try:
        whole.write_bytes(data.draw(damaged(before)))
        survive("object files", lambda: convert(place, place / "own" / "model.xml", whole=False))
    finally:
        whole.write_bytes(before)
