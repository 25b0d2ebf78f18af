"""How code written for the original uses it, condensed: evaluation scripts, dataset tools, training loops."""

import contextlib
import importlib.util
import math
import os
import pathlib
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.sim
SIZE = 32


def test_evaluation_script_of_a_vision_language_action_model():
    """As openpi and OpenVLA evaluate: one environment, fixed starts, pictures turned by half a turn."""
    from libero.libero import benchmark, get_libero_path
    from libero.libero.envs import OffScreenRenderEnv

    def quat2axisangle(quat):
        quat[3] = min(max(quat[3], -1.0), 1.0)
        den = np.sqrt(1.0 - quat[3] * quat[3])
        if math.isclose(den, 0.0):
            return np.zeros(3)
        return (quat[:3] * 2.0 * math.acos(quat[3])) / den

    task_suite = benchmark.get_benchmark_dict()["libero_object"]()
    assert task_suite.n_tasks == 10
    task = task_suite.get_task(2)
    initial_states = task_suite.get_task_init_states(2)
    task_bddl_file = pathlib.Path(get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
    env = OffScreenRenderEnv(bddl_file_name=task_bddl_file, camera_heights=SIZE, camera_widths=SIZE)
    env.seed(7)
    for episode in range(2):
        env.reset()
        obs = env.set_init_state(initial_states[episode])
        t, done = 0, False
        while t < 4 and not done:
            if t < 2:
                obs, reward, done, info = env.step([0.0] * 6 + [-1.0])
                t += 1
                continue
            image = np.ascontiguousarray(obs["agentview_image"][::-1, ::-1])
            wrist = np.ascontiguousarray(obs["robot0_eye_in_hand_image"][::-1, ::-1])
            axis = quat2axisangle(obs["robot0_eef_quat"])
            state = np.concatenate((obs["robot0_eef_pos"], axis, obs["robot0_gripper_qpos"]))
            assert image.shape == wrist.shape == (SIZE, SIZE, 3)
            assert state.shape == (8,)
            action = np.array([0.1, 0.0, -0.1, 0.0, 0.0, 0.0, -1.0])
            obs, reward, done, info = env.step(action.tolist())
            t += 1
    assert task.language == "pick up the salad dressing and place it in the basket"
    env.close()


def test_gymnasium_wrapper():
    """As LeRobot wraps it: torch-loaded starts, the controller's mode set, frames from `_get_observations`."""
    torch = pytest.importorskip("torch")
    from libero.libero import benchmark, get_libero_path
    from libero.libero.envs import OffScreenRenderEnv

    suite = benchmark.get_benchmark_dict()["libero_object"]()
    task = suite.get_task(0)
    path = (
        Path(get_libero_path("init_states")) / suite.tasks[0].problem_folder / suite.tasks[0].init_states_file
    )
    init_states = torch.load(path, weights_only=False)
    bddl = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
    env = OffScreenRenderEnv(**{"bddl_file_name": bddl, "camera_heights": SIZE, "camera_widths": SIZE})
    env.reset()
    env.seed(0)
    raw_obs = env.reset()
    raw_obs = env.set_init_state(init_states[3])
    for _ in range(2):
        raw_obs, _, _, _ = env.step([0, 0, 0, 0, 0, 0, -1])
    for robot in env.robots:
        robot.controller.use_delta = True
    assert env.robots[0].controller.ee_ori_mat.shape == (3, 3)
    assert raw_obs["robot0_joint_pos"].shape == raw_obs["robot0_joint_vel"].shape == (7,)
    raw_obs, reward, done, info = env.step(np.zeros(7, np.float32))
    assert (env.check_success(), bool(done)) == (False, False)
    info.update({"task": task.name, "is_success": done})
    frame = env.env._get_observations()["agentview_image"][::-1, ::-1]
    assert (frame == raw_obs["agentview_image"][::-1, ::-1]).all()
    env.close()


def test_evaluation_of_the_original():
    """As the original evaluates a policy: environments in processes, five idle steps, a film."""
    from libero.libero.benchmark import get_benchmark
    from libero.libero.envs import OffScreenRenderEnv, SubprocVectorEnv
    from libero.libero.utils.time_utils import Timer

    suite = get_benchmark("libero_object")(0)
    env_args = {
        "bddl_file_name": suite.get_task_bddl_file_path(5),
        "camera_heights": SIZE,
        "camera_widths": SIZE,
    }
    env_num = 2
    with Timer() as t:
        env = SubprocVectorEnv([lambda: OffScreenRenderEnv(**env_args) for _ in range(env_num)])
        env.reset()
        env.seed(100)
        init_states = suite.get_task_init_states(5)
        obs = env.set_init_state(init_states[np.arange(env_num) % init_states.shape[0]])
        for _ in range(2):
            obs, _, _, _ = env.step(np.zeros((env_num, 7)))
        obs, reward, done, info = env.step(np.zeros((env_num, 7)))
        dones = [bool(d) for d in done]
        env.close()
    assert dones == [False, False]
    assert [o["agentview_image"].shape for o in obs] == [(SIZE, SIZE, 3)] * env_num
    assert t.get_elapsed_time() > 0


def test_dataset_tool_of_the_original():
    """As the original turns states into observations: a problem class by its name, a stored model, states."""
    from libero.libero import benchmark
    from libero.libero.envs import TASK_MAPPING
    from libero.libero.envs import bddl_utils as BDDLUtils
    from libero.libero.utils.utils import postprocess_model_xml, update_env_kwargs

    suite = benchmark.get_benchmark("libero_object")()
    file = suite.get_task_bddl_file_path(0)
    info = BDDLUtils.get_problem_info(file)
    kwargs = {
        "robots": ["Panda"],
        "controller_configs": {"type": "OSC_POSE", "kp": 150, "control_delta": True},
        "reward_shaping": True,
        "control_freq": 20,
    }
    update_env_kwargs(
        kwargs,
        bddl_file_name=file,
        has_renderer=False,
        has_offscreen_renderer=True,
        ignore_done=True,
        use_camera_obs=True,
        camera_depths=False,
        camera_names=["robot0_eye_in_hand", "agentview"],
        camera_heights=SIZE,
        camera_widths=SIZE,
        camera_segmentations=None,
    )
    env = TASK_MAPPING[info["problem_name"]](**kwargs)
    env.reset()
    model_xml = postprocess_model_xml(env.sim.model.get_xml(), {})
    state = suite.get_task_init_states(0)[0]
    env.reset_from_xml_string(model_xml)
    env.sim.reset()
    env.sim.set_state_from_flattened(state)
    env.sim.forward()
    assert (env.sim.get_state().flatten() == state[: env.sim.get_state().flatten().size]).all()
    obs, reward, done, _ = env.step(np.zeros(7))
    assert env.get_robot_state_vector(obs).shape == (9,)
    assert np.isfinite(np.hstack((obs["robot0_eef_pos"], obs["robot0_eef_quat"]))).all()
    env.close()


def test_video_of_an_episode(tmp_path):
    from libero.libero.utils.video_utils import VideoWriter

    rng = np.random.default_rng(0)
    frames = [{"agentview_image": rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)} for _ in range(4)]
    has_av = importlib.util.find_spec("av") is not None
    warned = contextlib.nullcontext() if has_av else pytest.warns(UserWarning, match="writing GIF")
    with warned, VideoWriter(tmp_path / "film", save_video=True, single_video=False) as writer:
        for k, obs in enumerate(frames):
            writer.append_vector_obs([obs, obs], [k > 2, False])
        writer.reset()
    assert {path.stem for path in (tmp_path / "film").iterdir()} == {"0", "1"}
    with VideoWriter(tmp_path / "none") as writer:
        writer.append_obs(frames[0], False)
    assert not (tmp_path / "none").exists()
