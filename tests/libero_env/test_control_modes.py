"""Each controller reaches its goals, with the same bits in one simulation, in many, and from a restored state."""

import itertools

import numpy as np
import pytest

from libero_env import BatchEnv, Expert, LiberoEnv
from libero_env.envs.config import EnvConfig
from libero_env.errors import InvalidInputError
from libero_env.sim import controller as controllers

pytestmark = pytest.mark.sim
TASK = "libero_object/2"
MODES = [*itertools.product(controllers.CONTROLLERS, (True, False))]
MODES.remove(("joint_velocity", False))


def make(mode, cls=LiberoEnv, *args, **kwargs):
    return cls(TASK, *args, controller=mode[0], control_delta=mode[1], cameras=(), **kwargs)


def commands(env, steps, num, seed=0):
    """Return actions that move the arm a little with any controller."""
    rng, controller = np.random.default_rng(seed), env.simulations.controller_state.controller
    assert env.action_space.shape == (controller.action_dim,)
    small = rng.uniform(-1, 1, (steps, num, controller.action_dim))
    if controller.control_delta:
        return small
    here = {"osc_pose": np.append(env.view.eef_pos, [np.pi, 0, 0]), "osc_position": env.view.eef_pos}
    here = here.get(controller.name, env.simulations.fields["qpos"][0, :7])
    return np.append(here, 0.0) + small * np.append(np.full(here.size, 0.05), 1.0)


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_batch_and_states_give_the_same_bits(closing, mode):
    env, batch = closing(make(mode)), closing(make(mode, BatchEnv, 3, num_threads=2))
    env.reset(options={"init_state": 2})
    moves = commands(env, 8, 3)
    batch.reset(options={"init_state": 2})
    for move in moves:
        seen = batch.step(move)[0]
    for move in moves[:3, 1]:
        env.step(move)
    middle = env.get_state()
    for _ in range(2):
        env.set_state(middle)
        for move in moves[3:, 1]:
            single = env.step(move)[0]
    for key in single:
        np.testing.assert_array_equal(seen[key][1], single[key])
    np.testing.assert_array_equal(batch.get_state(1), env.get_state())


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_starts_do_not_depend_on_the_controller(closing, mode):
    env, usual = closing(make(mode)), closing(LiberoEnv(TASK, cameras=()))
    seen, expected = (one.reset(seed=4)[0]["joint_states"] for one in (env, usual))
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_array_equal(env.simulations.physics_state(0), usual.simulations.physics_state(0))


@pytest.mark.parametrize("name", ["osc_pose", "osc_position"])
def test_an_absolute_pose_is_reached(closing, name):
    env = closing(make((name, False)))
    env.reset(options={"init_state": 0})
    goal, turn = env.view.eef_pos + [0.05, -0.04, -0.03], [np.pi, 0.0, 0.0]
    action = np.array([*goal, *(turn if name == "osc_pose" else []), -1.0])
    for _ in range(60):
        env.step(action)
    np.testing.assert_allclose(env.view.eef_pos, goal, atol=5e-3)
    down = [[1, 0, 0], [0, -1, 0], [0, 0, -1]] if name == "osc_pose" else [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    np.testing.assert_allclose(env.view.eef_mat, down, atol=0.05)
    assert env.view.finger_pos[0] > 0.035


@pytest.mark.parametrize("delta", [True, False])
def test_absolute_joints_are_reached_and_deltas_are_relative_to_the_present(closing, delta):
    env = closing(make(("joint_position", delta)))
    env.reset(options={"init_state": 0})
    now = env.simulations.fields["qpos"][0, :7]
    goal = now + [0.2, -0.1, 0.1, 0.15, -0.1, 0.1, 0.2]
    for _ in range(80):
        env.step(np.append(np.clip((goal - now) / controllers.JOINT_SCALE, -1, 1) if delta else goal, 0.0))
    np.testing.assert_allclose(now, goal, atol=0.02)


def test_joint_velocities_are_reached(closing):
    env = closing(make(("joint_velocity", True), observations=["joint_velocities"]))
    env.reset(options={"init_state": 0})
    command = np.array([0.4, -0.2, 0.2, 0.3, -0.4, 0.3, 0.5, 0.0])
    for _ in range(15):
        seen = env.step(command)[0]
    np.testing.assert_allclose(seen["joint_velocities"], controllers.VELOCITY_SCALE * command[:7], atol=0.03)


def test_the_velocity_loop_is_a_pid_with_a_smoothed_derivative_that_stops_summing_when_it_saturates():
    rng, limit = np.random.default_rng(0), np.array([80.0] * 4 + [12.0] * 3)
    state = controllers.ControllerState(1, controllers.get_controller("joint_velocity"))
    state.goal[0] = rng.uniform(-0.5, 0.5, 7)
    bias, ctrl = rng.normal(size=(1, 9)), np.zeros((1, 9))
    total, last, changes, saturated = np.zeros(7), np.zeros(7), [], False
    unused = [np.zeros(shape) for shape in ((1, 9, 3), (1, 9, 3), (1, 3), (1, 9), (1, 81))]
    before, fingers = (
        (np.zeros(1, int), np.zeros((1, 8)), np.zeros((1, 9))),
        np.array([[0.0, 0.04], [-0.04, 0.0]]),
    )
    model = (np.zeros((7, 7), np.int64), limit, fingers, np.zeros(7), state.controller.gains)
    for velocity in np.cumsum(rng.normal(scale=0.02, size=(40, 7)), axis=0):
        qvel = np.append(velocity, [0.0, 0.0])[None]
        state.controller.kernel(*before, qvel, *unused, bias, *state.arrays, ctrl, *model)
        error = state.goal[0] - velocity
        changes, last = [*changes, error - last][-5:], error
        total = total if saturated else total + error
        wanted = 6 * limit * (error + 0.005 * total + 0.001 * np.mean(changes, axis=0)) + bias[0, :7]
        np.testing.assert_allclose(ctrl[0, :7], np.clip(wanted, -limit, limit), atol=1e-9)
        saturated = bool((np.abs(wanted) > limit).any())


@pytest.mark.parametrize("observed", ["after", "substep"])
def test_batch_and_single_simulations_have_the_same_bits_at_another_frequency(closing, observed):
    options = {"control_freq": 50, "observed": observed, "camera_size": (16, 16)}
    one, many = closing(LiberoEnv(TASK, **options)), closing(BatchEnv(TASK, 2, num_threads=1, **options))
    one.reset(options={"init_state": 3})
    many.reset(options={"init_state": 3})
    assert one.metadata["render_fps"] == many.metadata["render_fps"] == 50
    rng, before = np.random.default_rng(0), one.get_state()[0]
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, 7)
        seen, both = one.step(action)[0], many.step(np.stack([action] * 2))[0]
        for name, value in seen.items():
            np.testing.assert_array_equal(both[name][1], value, err_msg=name)
    assert np.isclose(one.get_state()[0] - before, 4 / 50)


@pytest.mark.parametrize(("options", "message"), [
    ({"control_freq": 0}, "control_freq"), ({"control_freq": 12.5}, "control_freq"),
    ({"control_freq": 30}, "30 Hz does not divide the 500 Hz of the physics; expected one of 1, 2,"),
    ({"control_freq": 250, "observed": "substep"}, "control_freq 250 .*at most 125, or observed=after"),
])  # fmt: skip
def test_frequencies_that_physics_steps_do_not_fill_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        EnvConfig(**options)


def test_the_expert_acts_at_one_frequency(closing):
    env = closing(LiberoEnv(TASK, cameras=(), control_freq=10))
    env.reset(options={"init_state": 0})
    with pytest.raises(InvalidInputError, match="the expert acts at 20 Hz; .* 50 physics steps per action"):
        Expert(env.task, np.random.default_rng(0)).act(env.view)
