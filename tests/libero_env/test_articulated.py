"""Fixtures with drawers, doors and knobs: parameters of their joints, and their range of motion."""

import mujoco
import numpy as np
import pytest

from libero_env.objects import get_object, object_names
from libero_env.objects.builtin.physics import load_physics
from tests.harness.models import bounds

pytestmark = pytest.mark.sim

PARTS = {name: load_physics(name).bodies.values() for name in object_names() if name != "target_zone"}
ARTICULATED = tuple(name for name, parts in PARTS.items() if any("joint" in part for part in parts))
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
    return request.param


def fixed(category: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the object alone, its root fixed at 1 m, with the options of the benchmark's scenes."""
    spec = get_object(category).spec
    spec.option.timestep = 0.002
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 20.0
    spec.body("main").pos = (0.0, 0.0, 1.0)
    model = spec.compile()
    return model, mujoco.MjData(model)


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


@pytest.fixture
def model(category) -> mujoco.MjModel:
    return get_object(category).spec.compile()


def test_joints(category, model, measured_objects):
    records = [joint for joint in measured_objects[category]["joints"] if joint["type"] != "free"]
    assert model.njnt == len(records)
    for index, record in enumerate(records):
        joint = model.jnt(index)
        # The measured names lack the category where they began with it.
        assert joint.name in (record["name"], f"{category}_{record['name']}")
        assert model.body(model.jnt_bodyid[index]).name.removeprefix(f"{category}_") == record["body"]
        assert joint.type[0] == getattr(mujoco.mjtJoint, f"mjJNT_{record['type'].upper()}")
        assert joint.range == pytest.approx(record["range"], abs=1e-6) and model.jnt_limited[index]
        assert joint.axis == pytest.approx(record["axis"], abs=1e-6)
        for key in ("damping", "frictionloss", "armature"):
            assert getattr(model, f"dof_{key}")[model.jnt_dofadr[index]] == pytest.approx(record[key])
    ranges = measured_objects[category]["object_properties"]["articulation"]
    expected = {key.split("_")[1]: tuple(value) for key, value in ranges.items() if value}
    assert dict(get_object(category).articulation) == expected


def test_bodies_and_their_sites(category, model, measured_objects):
    names = [model.body(body).name for body in range(1, model.nbody)]
    records = measured_objects[category]["bodies"]
    assert [name.removeprefix(f"{category}_") for name in names] == [record["name"] for record in records]
    for name, record in zip(names[1:], records[1:], strict=True):
        body = model.body(name)
        assert model.body(body.parentid[0]).name.removeprefix(f"{category}_") == record["parent"]
        assert body.mass[0] == pytest.approx(record["mass"], rel=0.1, abs=1e-4)
        assert body.pos == pytest.approx(record["pos"], abs=1e-4)
        assert np.abs(body.quat @ np.array(record["quat"])) == pytest.approx(1.0, abs=1e-4)
    for record in measured_objects[category]["sites"]:
        body = model.body(model.site(record["name"]).bodyid[0]).name
        assert body.removeprefix(f"{category}_") == record["body"]


def test_visual_geoms_coincide_with_collision_geoms(category):
    """The box around the visual geoms of a moving part is that around its collision geoms."""
    model, _ = fixed(category)
    for joint in range(model.njnt):
        of_body = np.flatnonzero(model.geom_bodyid == model.jnt_bodyid[joint])
        seen, solid = ([g for g in of_body if model.geom_group[g] == group] for group in (1, 0))
        # A capsule's or a turned box's bounds are a little wide: 6 mm.
        assert bounds(model, seen) == pytest.approx(bounds(model, solid), abs=0.006)


def test_closed_stays_closed(category):
    model, data = fixed(category)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.qpos == pytest.approx(np.zeros(model.nq), abs=1e-4) and data.ncon == 0


def test_a_force_moves_each_joint_through_its_range(category):
    model, data = fixed(category)
    for joint in range(model.njnt):
        mujoco.mj_resetData(model, data)
        low, high = STOPPED.get(category, model.jnt_range[joint])
        for way, end in ((1.0, high), (-1.0, low), (1.0, high)):
            push(model, data, joint, way, 3.0)
            reach = 0.01 * (high - low) + 0.0005
            assert data.qpos[joint] == pytest.approx(end, abs=reach), model.jnt(joint).name
        others = np.delete(np.arange(model.nq), joint)
        assert data.qpos[others] == pytest.approx(np.zeros(model.nq - 1), abs=1e-3)


def test_all_joints_open_together(category):
    model, data = fixed(category)
    ends = [max(STOPPED.get(category, limits), key=abs) for limits in model.jnt_range]
    for joint, end in enumerate(ends):
        push(model, data, joint, np.sign(end), 3.0)
    assert data.qpos == pytest.approx(np.array(ends), rel=0.02, abs=0.001)


def test_target_zone_is_visible_and_has_no_contacts():
    zone = get_object("target_zone")
    model = zone.spec.compile()
    assert model.nbody == 2 and model.njnt == 0 and model.body("main").mass[0] == 0
    assert not (model.geom_contype | model.geom_conaffinity).any() and (model.geom_group == 1).all()
    assert 0 < model.geom("visual").rgba[3] < 1
    site = model.site("default_site")
    assert site.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    assert site.size[:2] == pytest.approx(model.geom("visual").size[:2])
