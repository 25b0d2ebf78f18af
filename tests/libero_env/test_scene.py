"""Scene, placement, predicates and images."""

import os
import subprocess
import sys
from copy import copy

import mujoco
import numpy as np
import pytest

from libero_env.assets.pack import BuiltinPack
from libero_env.envs.env import LiberoEnv
from libero_env.errors import PlacementError
from libero_env.init_states.placement import lowest_point, sample_start
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import _SceneCache, build_scene
from libero_env.sim.state import StateView
from libero_env.tasks import bddl, get_suite, get_task
from libero_env.tasks.expression import And, Atom, ForAll, Not, Or

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def task():
    return get_task("libero_object/0")


@pytest.fixture(scope="module")
def scene(task):
    return build_scene(task.problem)


@pytest.fixture
def view(scene):
    simulations = LoopSimulations(scene.model)
    start = sample_start(scene, np.random.default_rng(0))
    simulations.reset([0], start.qpos[None], np.zeros((1, scene.model.nv)))
    return StateView(scene, simulations)


@pytest.mark.parametrize("task", get_suite("libero_object").tasks, ids=lambda task: task.id)
def test_joints_are_robot_gripper_objects_in_file_order(task):
    model = build_scene(task.problem).model
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names[:7] == [f"robot0_joint{i}" for i in range(1, 8)]
    assert names[9:] == [f"{name}_joint0" for name in task.problem.objects]


def test_the_workspace_has_the_measured_parameters(scene, measured_workspaces):
    figures = measured_workspaces["libero_floor_manipulation"]
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:9] = figures["arm_qpos"]
    mujoco.mj_forward(model, data)
    assert model.opt.timestep == figures["timestep"]
    assert model.opt.impratio == 20.0
    assert (model.opt.cone, model.opt.integrator) == (figures["cone"], figures["integrator"])
    assert (model.opt.density, model.opt.viscosity) == (figures["density"], figures["viscosity"])
    np.testing.assert_allclose(data.site("gripper0_grip_site").xpos, figures["grip_site_world"], atol=1e-5)
    for name, camera in figures["cameras"].items():
        mine = model.camera(name)
        assert model.body(int(mine.bodyid[0])).name == camera["body"]
        assert mine.fovy[0] == pytest.approx(camera["fovy"])
        np.testing.assert_allclose(mine.pos, camera["pos"], atol=1e-5)
        assert abs(mine.quat @ camera["quat_wxyz"]) == pytest.approx(1, abs=2e-3)
    for joint in figures["arm_joints"]:
        dof = model.joint(joint["name"]).dofadr[0]
        np.testing.assert_allclose(model.joint(joint["name"]).range, joint["range"])
        got = (model.dof_damping[dof], model.dof_armature[dof], model.dof_frictionloss[dof])
        np.testing.assert_allclose(got, (joint["damping"], joint["armature"], joint["frictionloss"]))
    for i, actuator in enumerate(figures["actuators"]):
        assert model.actuator(i).name == actuator["name"]
        np.testing.assert_allclose(model.actuator_ctrlrange[i], actuator["ctrlrange"])


def test_placement_fills_the_regions_and_nothing_touches(scene, task):
    data = mujoco.MjData(scene.model)
    for seed in range(20):
        data.qpos[:] = sample_start(scene, np.random.default_rng(seed)).qpos
        mujoco.mj_forward(scene.model, data)
        for atom in task.problem.init:
            (x0, y0, x1, y1), *_ = task.problem.region(atom.args[1]).ranges
            x, y, z = data.body(f"{atom.args[0]}_main").xpos
            assert x0 <= x <= x1 and y0 <= y <= y1
            quat = data.body(f"{atom.args[0]}_main").xquat
            assert z + lowest_point(scene, atom.args[0], quat) == pytest.approx(0.001, abs=1e-9)
        assert data.ncon == 0 or data.contact.dist[: data.ncon].min() > -1e-3


def test_sampling_in_the_model_of_a_simulation_leaves_it_as_it_was():
    cabinet = build_scene(get_task("libero_goal/3").problem)
    model = copy(cabinet.model)
    model.body_pos[cabinet.fixture_bodies] += 0.01  # of the simulation's own fixtures
    poses = model.body_pos.copy(), model.body_quat.copy()
    plain, sampled = (sample_start(cabinet, np.random.default_rng(0), None, m) for m in (None, model))
    assert np.array_equal(plain.qpos, sampled.qpos) and np.array_equal(plain.fixtures, sampled.fixtures)
    assert np.array_equal(model.body_pos, poses[0]) and np.array_equal(model.body_quat, poses[1])


def test_an_object_without_a_place_is_an_error(task):
    text = task.bddl_text.replace("(On milk_1 floor_other_object_region_2)", "")
    with pytest.raises(PlacementError, match="milk_1"):
        sample_start(build_scene(bddl.parse(text)), np.random.default_rng(0))


def test_predicates_do_not_change_the_state(view, task):
    before = view.simulations.get_state(0)
    evaluate(task.problem.goal, view)
    view.body_pos("milk_1")[:] = 9.0
    view.eef_pos[:] = 9.0
    np.testing.assert_array_equal(view.simulations.get_state(0), before)


def test_goals_can_be_nested(view):
    no = Atom("In", ("milk_1", "basket_1_contain_region"))
    assert not evaluate(no, view)
    yes = Not(no)
    assert evaluate(And((yes, Not(no))), view) and not evaluate(And((yes, no)), view)
    assert evaluate(Or((no, yes)), view) and not evaluate(Or((no, no)), view)
    body = Atom("In", ("?x", "basket_1_contain_region"))
    assert evaluate(ForAll((("?x", "milk"),), Not(body)), view)
    assert not evaluate(ForAll((("?x", "milk"),), body), view)


def test_images_are_upright_and_reproducible():
    env = LiberoEnv("libero_object/0", camera_size=(64, 64))
    frame = env.reset(options={"init_state": 0})[0]["agentview_rgb"]
    again = env.reset(options={"init_state": 0})[0]["agentview_rgb"]
    np.testing.assert_array_equal(frame, again)
    brown = (frame[..., 0] > frame[..., 2] * 1.6) & (frame[..., 0] > 60)
    assert brown[24:48, 40:].sum() > 5 * max(brown[:16, :32].sum(), 1), (
        "the basket is on the right, below middle"
    )
    env.close()


def test_contexts_are_freed():
    """Memory does not grow when environments are opened and closed repeatedly."""
    import resource

    def cycle(times):
        for _ in range(times):
            env = LiberoEnv("libero_object/0", camera_size=(64, 64))
            env.reset(options={"init_state": 0})
            env.close()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    cycle(4)
    before = cycle(4)
    assert cycle(12) - before < 60_000  # kB


PICTURE = """
import hashlib, os
from libero_env import LiberoEnv
env = LiberoEnv("libero_object/0", camera_size=(96, 96))
pictures, _ = env.reset(options={"init_state": 0})
print(hashlib.sha256(b"".join(v.tobytes() for k, v in pictures.items() if k.endswith("rgb"))).hexdigest())
print(os.environ["LP_NUM_THREADS"])
"""


def test_images_do_not_depend_on_the_threads_of_the_software_renderer():
    def draw(threads: str | None) -> list[str]:
        environment = {k: v for k, v in os.environ.items() if k != "LP_NUM_THREADS"}
        environment |= {} if threads is None else {"LP_NUM_THREADS": threads}
        command = [sys.executable, "-c", PICTURE]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    (default, without), (threaded, three) = draw(None), draw("3")
    assert (without, three) == ("0", "3") and default == threaded


@pytest.mark.parametrize(("named", "found"), [("", "cgl"), ("cgl", "cgl"), ("egl", "valid: cgl, glfw")])
def test_macos_draws_by_cgl(named, found):
    code = """
import importlib, sys, types
from libero_env.sim import render
sys.modules["mujoco.cgl"] = types.SimpleNamespace(GLContext=lambda width, height: None)
sys.platform = "darwin"
importlib.reload(render)
try:
    print(render.open_context(8, 8)[0])
except render.RenderError as error:
    print(error)
"""
    env = {**os.environ, "MUJOCO_GL": named}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert found in done.stdout


def test_compiled_scenes_are_kept_up_to_a_size():
    problems = [get_task(f"libero_object/{i}").problem for i in range(3)]
    kept = _SceneCache()
    first, second = (kept(problem, BuiltinPack(), "fast", "libero") for problem in problems[:2])
    assert kept(problems[0], BuiltinPack(), "fast", "libero") is first
    small = _SceneCache(mujoco.mj_sizeModel(first.model) + mujoco.mj_sizeModel(second.model), kept=1)
    found = [small(problem, BuiltinPack(), "fast", "libero") for problem in problems]
    assert small(problems[2], BuiltinPack(), "fast", "libero") is found[2]
    assert small(problems[0], BuiltinPack(), "fast", "libero") is not found[0], "the oldest is dropped"
    tiny = _SceneCache(0, kept=1)
    last = tiny(problems[0], BuiltinPack(), "fast", "libero")
    assert tiny(problems[0], BuiltinPack(), "fast", "libero") is last, "the last one stays"
