"""Arguments and settings of the original: obeyed as there, or refused by name.

Numbers are those of robosuite 1.4.0 with hf-libero 0.1.4 and MuJoCo 3.3.2, of the first task of libero_object.
"""

import numpy as np
import pytest

from libero._adapters.controllers import DEFAULTS
from libero._adapters.observations import Observable
from libero.libero.envs import TASK_MAPPING, ControlEnv
from libero_env import LiberoEnv
from libero_env.assets.robot import REST_QPOS
from libero_env.errors import LiberoError, UnknownNameError

pytestmark = pytest.mark.sim
BLIND = {"use_camera_obs": False}
POSES = [[-0.62, -0.02, 0.2], [-0.58, 0.02, 0.43]]
JOINTS = [[-0.1, -0.3, -0.1, -2.5, -0.1, 2.2, 0.7], [0.1, 0.1, 0.1, -2.4, 0.1, 2.3, 0.8]]
# Configuration, further arguments, and the joints after the eight actions of `drive`.
CONTROLLERS = [
    ({"type": "OSC_POSE", "kp": [50, 100, 150, 80, 90, 100], "damping_ratio": 0.5}, {},
     [0.053119, -0.214735, 0.13284, -2.370691, 0.185774, 2.236571, 0.714162]),
    ({"type": "OSC_POSE", "output_max": [0.1, 0.1, 0.1, 0.2, 0.2, 0.2],
     "output_min": [-0.05, -0.05, -0.05, -0.2, -0.2, -0.2]}, {}, [0.058168, -0.151707, 0.194949, -2.225997, 0.096196,
     2.123939, 0.923144]),
    ({"type": "OSC_POSE", "input_max": 0.5, "input_min": -0.25}, {},
     [0.052853, -0.236385, 0.116566, -2.365191, 0.073667, 2.251633, 0.859867]),
    ({"type": "OSC_POSE", "position_limits": POSES}, {},
     [0.090672, -1.40287, 0.024151, -3.072589, 0.088565, 1.53543, 0.748592]),
    ({"type": "OSC_POSITION", "output_max": 0.1, "output_min": -0.1, "kp": 80}, {},
     [0.026134, -0.221252, 0.091565, -2.374993, 0.025562, 2.13831, 0.886254]),
    ({"type": "JOINT_POSITION", "kp": [30, 40, 50, 60, 70, 80, 90], "damping_ratio": 0.7, "output_max": 0.1,
     "output_min": -0.1}, {}, [0.022585, -0.160099, -0.006575, -2.380718, 0.007707, 2.212318, 0.808013]),
    ({"type": "JOINT_POSITION", "qpos_limits": JOINTS}, {},
     [0.011515, -0.162099, -0.002928, -2.424948, 0.002821, 2.226544, 0.777642]),
    ({"type": "JOINT_VELOCITY"}, {}, [0.06992, -0.130775, -0.013531, -2.354503, -0.008175, 2.210815, 0.815724]),
    ({"type": "JOINT_VELOCITY", "kp": 1.0, "output_max": 1.0, "velocity_limits": [-0.3, 0.4]}, {},
     [0.101252, -0.088099, 0.060957, -2.328058, 0.063836, 2.264075, 0.849023]),
    ({"type": "JOINT_VELOCITY", "kp": [10.0, 20, 30, 40, 5, 6, 7]}, {},
     [0.017369, -0.14285, -0.012691, -2.367325, 0.008638, 2.212301, 0.816814]),
    ({"type": "OSC_POSE"}, {"control_freq": 10},
     [0.061666, -0.240983, 0.138981, -2.332332, 0.252187, 2.280223, 0.694333]),
    ({"type": "OSC_POSE"}, {"control_freq": 30},
     [0.032213, -0.191202, 0.060192, -2.411076, 0.083726, 2.231566, 0.748523]),
    ({"type": "JOINT_VELOCITY"}, {"control_freq": 10},
     [0.095325, -0.132848, -0.020798, -2.25402, -0.019433, 2.163287, 0.815984]),
]  # fmt: skip


def drive(env, steps=8):
    """Act at random, the same for all controllers; return the joints of the arm."""
    rng = np.random.RandomState(0)
    for _ in range(steps):
        env.step(np.append(rng.uniform(-1.3, 1.3, env.env.action_dim - 1), 1.0))
    return env.sim.data.qpos[:7].copy()


@pytest.mark.parametrize(("config", "arguments", "joints"), CONTROLLERS)
def test_configurations_of_controllers_move_the_arm_as_in_the_original(make_env, config, arguments, joints):
    env = make_env(controller=config, **arguments, **BLIND)
    env.reset()
    np.testing.assert_allclose(drive(env), joints, atol=1.5e-6)
    assert np.isclose(env.env.cur_time, 8 / arguments.get("control_freq", 20))


def test_the_native_environment_moves_at_10_hz_as_the_original_does(make_env):
    hz = 10
    joints = next(q for config, more, q in CONTROLLERS if config["type"][:3] == "OSC" and hz in more.values())
    env = make_env(**BLIND, control_freq=hz)
    env.reset()
    start, bodies = env.sim.get_state().flatten(), env.env.simulations.read_fixtures()
    with LiberoEnv("libero_object/0", cameras=(), control_freq=hz) as native:
        native.simulations.fixtures[0] = bodies
        native.set_state(start)
        rng = np.random.RandomState(0)
        for _ in range(8):
            native.step(np.append(rng.uniform(-1.3, 1.3, 6), 1.0))
        np.testing.assert_allclose(native.simulations.fields["qpos"][0, :7], joints, atol=1.5e-6)
        assert np.isclose(native.get_state()[0] - start[0], 8 / hz)


def test_gains_and_scales_of_a_controller_can_be_set_until_the_next_reset(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.robots[0].controller.kp = np.full(6, 50.0)
    soft = [0.011526, -0.17678, 0.023962, -2.413811, 0.076054, 2.215168, 0.718112]
    np.testing.assert_allclose(drive(env), soft, atol=1.5e-6)
    env.reset()
    controller = env.robots[0].controller
    controller.output_max, controller.output_min = np.full(6, 0.1), np.full(6, -0.1)
    far = [0.056265, -0.24087, 0.186163, -2.411649, 0.089417, 2.160899, 0.935185]
    np.testing.assert_allclose(drive(env), far, atol=1.5e-6)


def test_the_rest_pose_and_absolute_poses_of_a_controller(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.robots[0].controller.initial_joint = np.array(REST_QPOS) + [0.5, -0.3, 0.5, 0.2, 0.3, -0.2, 0.4]
    pulled = [0.142325, -0.210039, -0.015118, -2.389578, 0.118885, 2.237281, 0.740729]
    np.testing.assert_allclose(drive(env), pulled, atol=1.5e-6)
    env.reset()
    assert env.robots[0].controller.initial_joint.tolist() == list(REST_QPOS)
    env.robots[0].controller.use_delta = False
    rng = np.random.RandomState(0)
    for _ in range(8):
        env.step([*rng.uniform(-0.3, 0.3, 6) + [-0.15, 0.0, 0.4, 3.0, 0.0, 0.0], 1.0])
    reached = [-0.073575, -0.361918, 0.085319, -2.186173, 0.093406, 1.774122, 1.230745]
    np.testing.assert_allclose(env.sim.data.qpos[:7], reached, atol=5e-6)
    assert env.env.action_spec[1].tolist() == [1.0] * 7
    for name in ("impedance_mode", "uncoupling", "orientation_limits", "interpolator_pos"):
        with pytest.raises(AttributeError, match=name):
            setattr(env.robots[0].controller, name, 3)


@pytest.mark.parametrize("hard_reset", [True, False])
def test_a_hard_reset_undoes_what_was_changed_and_another_keeps_it(make_env, hard_reset):
    env = make_env(**BLIND, hard_reset=hard_reset)
    for _ in range(3):
        env.reset()
        model, robot = env.sim.model, env.robots[0]
        model.cam_pos[0] *= 2.0
        model.body_mass[5] *= 2.0
        model.opt.gravity[2] /= 2.0
        model.opt.impratio *= 2.0
        model.vis.headlight.ambient[:] /= 2.0
        model.tex_data[:9] = 7
        robot.controller_config["kp"] = 50
        robot.controller_config["output_max"][0] = 0.2
        robot.controller.use_delta = False
        robot.init_qpos = np.array(REST_QPOS) + 0.05
    built = env.env.scene.model
    env.reset()
    model, robot, times = env.sim.model, env.robots[0], 1 if hard_reset else 8
    np.testing.assert_array_equal(model.cam_pos[0], times * built.cam_pos[0])
    assert model.body_mass[5] == times * built.body_mass[5]
    assert model.opt.gravity[2] == built.opt.gravity[2] / times
    assert model.opt.impratio == times * built.opt.impratio
    assert (model.vis.headlight.ambient == built.vis.headlight.ambient / np.float32(times)).all()
    assert (model.tex_data[:9] == 7).all() == (not hard_reset)
    assert robot.controller.kp.tolist() == [150.0 if hard_reset else 50.0] * 6
    assert robot.controller.output_max[0] == (0.05 if hard_reset else 0.2)
    assert robot.controller.use_delta  # the controller is new in both
    np.testing.assert_allclose(env.sim.data.qpos[:7], np.array(REST_QPOS) + (not hard_reset) * 0.05)
    assert DEFAULTS["OSC_POSE"]["output_max"][0] == 0.05


@pytest.mark.parametrize("hard_reset", [True, False])
def test_a_hard_reset_makes_the_robot_of_its_configuration(make_env, hard_reset):
    env = make_env(**BLIND, hard_reset=hard_reset)
    env.reset()
    env.env.robot_configs[0]["controller_config"]["kp"] = 50
    with pytest.raises(TypeError):
        env.env.robot_configs[0]["control_freq"] = 10
    env.reset()
    assert env.robots[0].controller.kp.tolist() == [50.0 if hard_reset else 150.0] * 6


@pytest.mark.parametrize("name", DEFAULTS)
def test_torques_are_clipped_at_the_limits_of_the_model(make_env, name):
    """As in robosuite: at once, but by the controller of joint velocities at those of the last reset."""
    config = {"type": name, "output_max": 500.0, "output_min": -500.0}
    env = make_env(controller=config, **BLIND, hard_reset=False)
    env.reset()
    for limit in (0.1, 400.0):
        env.sim.model.actuator_ctrlrange[0] = -limit, limit
        assert env.robots[0].torque_limits[1][0] == limit
        assert env.robots[0].controller.actuator_max[0] == 80.0
        env.step([1.0] * env.env.action_dim)
        force = env.sim.data.actuator_force[0]
        assert force == (min(limit, 80.0) if name == "JOINT_VELOCITY" else limit)
    env.reset()
    assert env.robots[0].controller.actuator_max[0] == 400.0


def test_a_hard_reset_returns_from_a_model_of_text_and_observables_are_kept(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.env.add_observable(Observable("two", lambda seen: 2.0, modality="own"))
    env.reset_from_xml_string(env.sim.model.get_xml().replace('density="1.2"', 'density="3"'))
    assert env.sim.model.opt.density == 3.0
    env.reset()
    assert env.sim.model.opt.density == 1.2
    assert env.step(np.zeros(7))[0]["two"] == 2.0


@pytest.mark.parametrize(("calls", "lag"), [(0, 0), (1, 1), (2, 2), (25, 0)])
def test_observations_are_as_many_physics_steps_old_as_states_were_set_after_a_reset(make_env, calls, lag):
    env = make_env(**BLIND)
    env.reset()
    state = env.get_sim_state()
    for _ in range(calls):
        env.set_init_state(state)
    ages = []
    for _ in range(6):
        seen = env.step([0.3] * 6 + [-1.0])[0]["robot0_joint_pos"]
        qpos, speed = env.sim.data.qpos[:7], env.sim.data.qvel[:7]
        fastest = np.abs(speed).argmax()
        ages.append(round((qpos - seen)[fastest] / speed[fastest] / 0.002))
    assert ages == [lag] * 6
    env.regenerate_obs_from_state(env.get_sim_state())
    env.step([0.3] * 6 + [-1.0])
    env.reset()
    seen = env.step([0.3] * 6 + [-1.0])[0]["robot0_joint_pos"]
    assert (seen == env.sim.data.qpos[:7]).all()


def test_pose_and_velocity_of_the_hand_are_in_the_frame_of_the_base(make_env):
    env = make_env(**BLIND)
    env.reset()
    drive(env, steps=3)
    hand = {
        "_hand_pos": [0.453868, 0.025017, 0.364334],
        "_hand_quat": [0.998078, 0.047319, -0.023921, 0.032065],
        "_hand_vel": [0.112823, 0.316797, 0.109806],
        "_hand_ang_vel": [-1.698902, -0.336817, 1.325826],
    }
    for name, value in hand.items():
        np.testing.assert_allclose(getattr(env.robots[0], name), value, atol=1.5e-6, err_msg=name)
    assert env.robots[0]._hand_quat.dtype == np.float32
    np.testing.assert_allclose(env.robots[0]._hand_pose[:3, 3], hand["_hand_pos"], atol=1.5e-6)


def test_noise_of_the_first_joints(make_env):
    spreads = {}
    for noise in (
        None, "default", {"magnitude": 0.2, "type": "uniform"}, {"magnitude": None, "type": "gaussian"}
    ):  # fmt: skip
        env = make_env(**BLIND, initialization_noise=noise)
        env.seed(0)
        moved = []
        for _ in range(4):
            env.reset()
            moved.append(env.sim.data.qpos[:7] - REST_QPOS)
            assert (env.robots[0].controller.initial_joint == env.sim.data.qpos[:7]).all()
        spreads[str(noise)] = np.abs(moved).max()
    none, default, uniform, zero = spreads.values()
    assert none == zero == 0.0
    assert 0.02 < default < 0.1
    assert 0.1 < uniform <= 0.2


def test_rooms_of_the_arguments(make_env):
    usual, warm, dark = (
        make_env(**BLIND, **arguments).env.scene.model
        for arguments in (
            {"scene_xml": "scenes/libero_floor_base_style.xml"},
            {"scene_properties": {"floor_style": "wood-plank", "wall_style": "yellow-linen"}},
            {"scene_xml": None, "scene_properties": {"floor_style": "dark"}},
        )
    )
    pictures = [model.tex_data.tobytes() for model in (make_env(**BLIND).env.scene.model, usual, warm, dark)]
    assert pictures[0] == pictures[1]
    assert len(set(pictures)) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"controller": {"type": "OSC_POSE", "impedance_mode": "variable"}}, "impedance_mode='variable': not supp"),
        ({"controller": {"type": "OSC_POSE", "kd": 3}}, "unknown key of the controller OSC_POSE 'kd'"),
        ({"controller": {"type": "JOINT_POSITION", "output_max": [0.1] * 6}}, "output_max=.*; expected .* 7 numbers"),
        ({"controller": {"type": "OSC_POSE", "position_limits": 1.0}}, "position_limits=1.0; expected two rows of 3"),
        ({"controller": "IK_POSE"}, "unknown controller 'IK_POSE'"),
        ({"control_freq": 0}, "control_freq=0; expected a number above 0"),
        ({"control_freq": "20"}, "control_freq='20'; expected a number above 0"),
        ({"gripper_types": None}, "gripper_types=None: not supported"),
        ({"scene_xml": "scenes/libero_tabletop_base_style.xml"}, "scene_xml=.*: not supp.* scenes/libero_f"),
        ({"scene_properties": {"floor_style": "lava"}}, "unknown floor style 'lava'"),
        ({"scene_properties": {"roof_style": "dark"}}, "unknown scene property 'roof'"),
        ({"initialization_noise": {"magnitude": 0.1, "type": "pink"}}, "initialization_noise=.*; expected 'default'"),
    ],
)  # fmt: skip
def test_what_is_not_obeyed_is_refused_by_name(suite, arguments, message):
    with pytest.raises((LiberoError, UnknownNameError), match=message):
        ControlEnv(suite.get_task_bddl_file_path(0), **arguments, **BLIND)


def test_the_problem_classes_have_the_original_default_controller(suite):
    env = TASK_MAPPING["libero_floor_manipulation"](suite.get_task_bddl_file_path(0), **BLIND)
    assert env.robots[0].controller.name == "JOINT_VELOCITY"
    np.testing.assert_allclose(env.robots[0].controller.kp, [4.8] * 5 + [0.72] * 2)
    with pytest.raises(LiberoError, match="JOINT_VELOCITY: its gains are those of the configuration"):
        env.robots[0].controller.kp = 1.0
    env.close()


def test_a_controller_of_robosuite_is_taken_with_what_its_robot_adds(make_env):
    added = {"robot_name": "Panda", "sim": object(), "ndim": 7, "policy_freq": 20, "use_delta": True}
    env = make_env(controller=[{"type": "OSC_POSITION", **DEFAULTS["OSC_POSITION"], **added}], **BLIND)
    assert "sim" not in env.robots[0].controller_config
    assert env.env.action_dim == 4
    env.reset()
    env.step(np.zeros(7))  # as long as that of OSC_POSE
