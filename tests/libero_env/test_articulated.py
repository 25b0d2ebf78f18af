"""Fixtures with drawers, doors and knobs: parameters of their joints, and their range of motion."""

import mujoco
import numpy as np
import pytest

from libero_env.objects import get_object, object_names
from libero_env.objects.builtin.physics import load_physics
from libero_env.objects.model import GLOW_GROUP
from libero_env.sim.render import Renderer, RenderTarget
from tests.harness.models import bounds

pytestmark = pytest.mark.sim

ARTICULATED = tuple(
    name
    for name in object_names()
    if name != "target_zone" and any("joint" in part for part in load_physics(name).bodies.values())
)
STOPPED = {  # category -> how far its parts get, m: to the frame, the shelf, the back
    "short_cabinet": (-0.0015, 0.16),
    "white_cabinet": (-0.16, 0.0020),
    "window": (0.0, 0.1005),
    "wooden_cabinet": (-0.16, 0.0020),
}
SPEED = {mujoco.mjtJoint.mjJNT_SLIDE: 0.2, mujoco.mjtJoint.mjJNT_HINGE: 1.5}  # m/s, rad/s
FIRM = 1e-3  # kg, kg m^2: what a part has at least, so that a force moves it at a finite speed


@pytest.fixture(params=ARTICULATED)
def category(request) -> str:
    """Articulated category, each in turn."""
    return request.param


def fixture_spec(category: str) -> mujoco.MjSpec:
    """Compile the object alone, its root fixed at 1 m, with the options of the benchmark's scenes."""
    spec = get_object(category).spec
    spec.option.timestep = 0.002
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 20.0
    spec.body("main").pos = (0.0, 0.0, 1.0)
    return spec


def push(model: mujoco.MjModel, data: mujoco.MjData, joint: int, way: float, seconds: float) -> None:
    """Drive a joint by a force that keeps a speed and never exceeds that of a hand."""
    dof = model.jnt_dofadr[joint]
    speed = way * SPEED[mujoco.mjtJoint(model.jnt_type[joint])]
    limit = model.dof_damping[dof] * abs(speed) + 3.0
    for _ in range(round(seconds / model.opt.timestep)):
        inertia = max(model.dof_M0[dof], FIRM)
        force = model.dof_damping[dof] * speed + 50.0 * inertia * (speed - data.qvel[dof])
        data.qfrc_applied[dof] = np.clip(force, -limit, limit)
        mujoco.mj_step(model, data)


def extremes(category: str, model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return the range of motion of a joint, rad or m."""
    return STOPPED.get(category, tuple(model.jnt_range[joint]))


def test_there_are_ten():
    assert len(ARTICULATED) == 10


def test_joints(category, measured_objects):
    model = get_object(category).spec.compile()
    records = [joint for joint in measured_objects[category]["joints"] if joint["type"] != "free"]
    assert model.njnt == len(records)
    for index, record in enumerate(records):
        joint = model.jnt(index)
        # The measured names lack the category where they began with it.
        assert joint.name in (record["name"], f"{category}_{record['name']}")
        assert model.body(model.jnt_bodyid[index]).name.removeprefix(f"{category}_") == record["body"]
        kind = {"hinge": mujoco.mjtJoint.mjJNT_HINGE, "slide": mujoco.mjtJoint.mjJNT_SLIDE}[record["type"]]
        assert joint.type[0] == kind
        assert joint.range == pytest.approx(record["range"], abs=1e-6) and model.jnt_limited[index]
        assert joint.axis == pytest.approx(record["axis"], abs=1e-6)
        dof = model.jnt_dofadr[index]
        for key in ("damping", "frictionloss", "armature"):
            assert getattr(model, f"dof_{key}")[dof] == pytest.approx(record[key])


def test_bodies(category, measured_objects):
    model = get_object(category).spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = [model.body(body).name for body in range(1, model.nbody)]
    assert [name.removeprefix(f"{category}_") for name in names] == [
        b["name"] for b in measured_objects[category]["bodies"]
    ]
    for name, record in zip(names[1:], measured_objects[category]["bodies"][1:], strict=True):
        body = model.body(name)
        assert model.body(body.parentid[0]).name.removeprefix(f"{category}_") == record["parent"]
        assert body.mass[0] == pytest.approx(record["mass"], rel=0.1, abs=1e-4)
        assert body.pos == pytest.approx(record["pos"], abs=1e-4)
        turned = np.abs(body.quat @ np.array(record["quat"]))
        assert turned == pytest.approx(1.0, abs=1e-4)


def test_sites_move_with_their_part(category, measured_objects):
    model = get_object(category).spec.compile()
    for record in measured_objects[category]["sites"]:
        body = model.body(model.site(record["name"]).bodyid[0]).name
        assert body.removeprefix(f"{category}_") == record["body"]


def test_articulation_ranges(category, measured_objects):
    ranges = measured_objects[category]["object_properties"]["articulation"]
    expected = {key.split("_")[1]: tuple(value) for key, value in ranges.items() if value}
    assert dict(get_object(category).articulation) == expected


def test_each_moving_part_carries_a_visual(category):
    model = get_object(category).spec.compile()
    for joint in range(model.njnt):
        of_body = np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[joint])
        assert (model.geom_group[of_body] == 1).any() and (model.geom_group[of_body] == 0).any()


def test_visual_geoms_coincide_with_collision_geoms(category):
    """The box around the visual geoms of a moving part is that around its collision geoms."""
    model = fixture_spec(category).compile()
    for joint in range(model.njnt):
        of_body = np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[joint])
        seen, solid = ([g for g in of_body if model.geom_group[g] == group] for group in (1, 0))
        # A capsule's or a turned box's bounds are a little wide: 6 mm.
        assert bounds(model, seen) == pytest.approx(bounds(model, solid), abs=0.006)


def test_closed_stays_closed(category):
    model = fixture_spec(category).compile()
    data = mujoco.MjData(model)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.qpos == pytest.approx(np.zeros(model.nq), abs=1e-4) and data.ncon == 0


def test_a_force_moves_each_joint_through_its_range(category):
    model = fixture_spec(category).compile()
    for joint in range(model.njnt):
        data = mujoco.MjData(model)
        low, high = extremes(category, model, joint)
        for way, end in ((1.0, high), (-1.0, low), (1.0, high)):
            push(model, data, joint, way, 3.0)
            reach = 0.01 * (high - low) + 0.0005
            assert data.qpos[joint] == pytest.approx(end, abs=reach), model.jnt(joint).name
        others = np.delete(np.arange(model.nq), joint)
        assert data.qpos[others] == pytest.approx(np.zeros(model.nq - 1), abs=1e-3)


def test_all_joints_open_together(category):
    model = fixture_spec(category).compile()
    data = mujoco.MjData(model)
    ends = [max(extremes(category, model, joint), key=abs) for joint in range(model.njnt)]
    for joint, end in enumerate(ends):
        push(model, data, joint, np.sign(end), 3.0)
    assert data.qpos == pytest.approx(np.array(ends), rel=0.02, abs=0.001)


def test_burner_glows_only_in_its_group():
    model = get_object("flat_stove").spec.compile()
    assert model.site("burner").group[0] == GLOW_GROUP
    assert [model.site(i).name for i in np.flatnonzero(model.site_group == GLOW_GROUP)] == ["burner"]


def test_a_turned_on_burner_is_red_from_above():
    spec = get_object("flat_stove").spec
    spec.worldbody.add_light(pos=(0.3, 0.3, 2), dir=(-0.1, -0.1, -1))
    spec.worldbody.add_camera(name="above", pos=(0.15, 0.0, 0.32), quat=(1.0, 0.0, 0.0, 0.0))
    model = spec.compile()
    data, redness = mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    renderer, picture = Renderer(model, 64, 64), np.zeros((64, 64, 3), np.uint8)
    for glowing in ((), (model.site("burner").id,)):
        renderer.render(data, [RenderTarget(renderer.camera_id("above"), picture)], glowing)
        rgb = picture.astype(int)
        redness.append(((rgb[..., 0] - rgb[..., 1:].max(axis=-1)) > 60).mean())
    renderer.close()
    assert redness[0] == 0.0 and redness[1] > 0.03


def test_target_zone_is_visible_and_has_no_contacts():
    zone = get_object("target_zone")
    model = zone.spec.compile()
    assert model.nbody == 2 and model.njnt == 0 and model.body("main").mass[0] == 0
    assert not (model.geom_contype | model.geom_conaffinity).any() and (model.geom_group == 1).all()
    assert 0 < model.geom("visual").rgba[3] < 1
    site = model.site("default_site")
    assert site.type[0] == mujoco.mjtGeom.mjGEOM_BOX and site.size[:2] == pytest.approx(
        model.geom("visual").size[:2]
    )
