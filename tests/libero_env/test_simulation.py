"""Motion agrees with recordings of the original, and has the same bits in one simulation and in many."""

import numpy as np
import pytest

from libero_env.sim.back_ends import BatchSimulations, LoopSimulations
from libero_env.sim.osc import ArmIndex
from libero_env.sim.scene import build_scene
from libero_env.sim.simulation import Batch
from libero_env.tasks import get_task

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def scene():
    return build_scene(get_task("libero_object/0").problem)


def start(scene, num):
    qpos = np.tile(scene.model.qpos0, (num, 1))
    qpos[:, :7] = [0.0, -0.16, 0.0, -2.44, 0.0, 2.23, 0.785]
    for i, name in enumerate(scene.objects):
        address = scene.model.joint(f"{name}_joint0").qposadr[0]
        qpos[:, address : address + 3] = [0.1 * i - 0.3, 0.3, 0.05 + 0.01 * i]
    qpos[:, 0] += 0.01 * np.arange(num)
    return qpos, np.zeros((num, scene.model.nv))


def actions(num, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, num, 7))


@pytest.mark.skipif(Batch is None, reason="MuJoCo older than 4 has no batch")
@pytest.mark.parametrize(("num", "threads"), [(2, 1), (3, 2), (5, 4)])
def test_a_batch_gives_the_bits_of_single_simulations(scene, num, threads):
    qpos, qvel = start(scene, num)
    batch, loop = BatchSimulations(scene.model, num, threads), LoopSimulations(scene.model, num)
    singles = [LoopSimulations(scene.model) for _ in range(num)]
    for simulations in (batch, loop):
        simulations.reset(range(num), qpos, qvel)
    for i, single in enumerate(singles):
        single.reset([0], qpos[i : i + 1], qvel[i : i + 1])
    for t, command in enumerate(actions(num, 30)):
        moving = [i for i in range(num) if (t + i) % 5]  # now and then one stands still
        batch.step(moving, command)
        loop.step(moving, command)
        for i in moving:
            singles[i].step([0], command[i : i + 1])
    for i, single in enumerate(singles):
        np.testing.assert_array_equal(batch.get_state(i), single.get_state(0))
        np.testing.assert_array_equal(loop.get_state(i), single.get_state(0))
        for name in ("xpos", "site_xpos", "qfrc_bias", "M"):
            np.testing.assert_array_equal(batch.fields[name][i], single.fields[name][0], err_msg=name)


@pytest.mark.parametrize("kind", [LoopSimulations, BatchSimulations])
def test_a_restored_state_continues_to_the_same_bits(scene, kind):
    simulations = kind(scene.model, 2)
    simulations.reset(range(2), *start(scene, 2))
    commands = actions(2, 24)
    for command in commands[:12]:
        simulations.step(range(2), command)
    kept = simulations.get_state(1)
    assert kept.shape == (simulations.state_size,)
    for command in commands[12:]:
        simulations.step(range(2), command)
    expected = simulations.get_state(1)
    simulations.set_state(1, kept)
    np.testing.assert_array_equal(simulations.get_state(1), kept)
    for command in commands[12:]:
        simulations.step([1], command)
    np.testing.assert_array_equal(simulations.get_state(1), expected)


def test_zero_action_holds_the_pose_and_the_gripper(scene):
    simulations = LoopSimulations(scene.model)
    simulations.reset([0], *start(scene, 1))
    grip = simulations.fields["site_xpos"][0, simulations.arm.site].copy()
    for _ in range(20):
        simulations.step([0], np.zeros((1, 7)))
    now = simulations.fields["site_xpos"][0, simulations.arm.site]
    assert np.linalg.norm(now - grip) < 2e-3
    assert (simulations.controller_state.gripper == 0).all()


def test_the_gripper_opens_at_minus_one_and_closes_at_plus_one(scene):
    simulations = LoopSimulations(scene.model)
    simulations.reset([0], *start(scene, 1))
    widths = []
    for direction in (-1.0, 1.0):
        for _ in range(30):
            simulations.step([0], np.array([[0, 0, 0, 0, 0, 0, direction]]))
        left, right = simulations.fields["qpos"][0, 7:9]
        widths.append(left - right)
    assert widths[0] > 0.075
    assert widths[1] < 0.005


def test_the_block_of_the_mass_matrix_agrees_with_mujoco(scene):
    import mujoco

    data = mujoco.MjData(scene.model)
    data.qpos[:] = start(scene, 1)[0][0]
    mujoco.mj_forward(scene.model, data)
    full = np.zeros((scene.model.nv, scene.model.nv))
    for k in range(scene.model.nv):
        unit = np.eye(scene.model.nv)[k]
        mujoco.mj_mulM(scene.model, data, full[k], unit)
    np.testing.assert_allclose(
        data.M[ArmIndex.from_model(scene.model).mass_address], full[:7, :7], atol=1e-12
    )
