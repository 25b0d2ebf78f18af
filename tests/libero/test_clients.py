"""How code written for the original uses it, condensed: evaluation scripts, dataset tools, training loops."""

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

    task_suite = benchmark.get_benchmark_dict()["libero_object"]()
    task, initial_states = task_suite.get_task(2), task_suite.get_task_init_states(2)
    assert task.language == "pick up the salad dressing and place it in the basket"
    task_bddl_file = pathlib.Path(get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
    env = OffScreenRenderEnv(bddl_file_name=task_bddl_file, camera_heights=SIZE, camera_widths=SIZE)
    env.seed(7)
    for episode in range(2):
        env.reset()
        obs = env.set_init_state(initial_states[episode])
        for _ in range(2):
            obs, reward, done, info = env.step([0.0] * 6 + [-1.0])
        image = np.ascontiguousarray(obs["agentview_image"][::-1, ::-1])
        quat = obs["robot0_eef_quat"]
        quat[3] = min(max(quat[3], -1.0), 1.0)  # they write into it
        state = np.concatenate((obs["robot0_eef_pos"], quat[:3], obs["robot0_gripper_qpos"]))
        assert (image.shape, state.shape) == ((SIZE, SIZE, 3), (8,))
    env.close()


def test_gymnasium_wrapper():
    """As LeRobot wraps it: torch-loaded starts, the controller's mode set, frames from `_get_observations`."""
    torch = pytest.importorskip("torch")
    from libero.libero import benchmark, get_libero_path
    from libero.libero.envs import OffScreenRenderEnv

    suite = benchmark.get_benchmark_dict()["libero_object"]()
    task = suite.get_task(0)
    path = Path(get_libero_path("init_states")) / task.problem_folder / task.init_states_file
    init_states = torch.load(path, weights_only=False)
    bddl = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
    env = OffScreenRenderEnv(**{"bddl_file_name": bddl, "camera_heights": SIZE, "camera_widths": SIZE})
    env.reset()
    env.set_init_state(init_states[3])
    env.step([0, 0, 0, 0, 0, 0, -1])
    for robot in env.robots:
        robot.controller.use_delta = True
    assert env.robots[0].controller.ee_ori_mat.shape == (3, 3)
    raw_obs, reward, done, info = env.step(np.zeros(7, np.float32))
    assert (env.check_success(), bool(done)) == (False, False)
    frame = env.env._get_observations()["agentview_image"][::-1, ::-1]
    assert (frame == raw_obs["agentview_image"][::-1, ::-1]).all()
    env.close()


def test_dataset_tool_of_the_original():
    """As the original turns states into observations: a problem class by its name, a stored model, states."""
    from libero.libero import benchmark
    from libero.libero.envs import TASK_MAPPING
    from libero.libero.envs import bddl_utils as BDDLUtils
    from libero.libero.utils.utils import postprocess_model_xml, update_env_kwargs

    suite = benchmark.get_benchmark("libero_object")()
    file = suite.get_task_bddl_file_path(0)
    controller = {"type": "OSC_POSE", "kp": 150, "control_delta": True}
    kwargs = {"robots": ["Panda"], "controller_configs": controller, "reward_shaping": True}
    kwargs |= {"control_freq": 20, "has_renderer": False, "has_offscreen_renderer": True, "ignore_done": True}
    cameras = {"camera_names": ["robot0_eye_in_hand", "agentview"], "camera_segmentations": None}
    size = {"camera_depths": False, "camera_heights": SIZE, "camera_widths": SIZE}
    update_env_kwargs(kwargs, bddl_file_name=file, use_camera_obs=True, **cameras, **size)
    env = TASK_MAPPING[BDDLUtils.get_problem_info(file)["problem_name"]](**kwargs)
    env.reset()
    model_xml = postprocess_model_xml(env.sim.model.get_xml(), {})
    state = suite.get_task_init_states(0)[0]
    env.reset_from_xml_string(model_xml)
    env.sim.reset()
    env.sim.set_state_from_flattened(state)
    env.sim.forward()
    assert (env.sim.get_state().flatten() == state[: env.sim.get_state().flatten().size]).all()
    obs, *_ = env.step(np.zeros(7))
    assert env.get_robot_state_vector(obs).shape == (9,)
    assert np.isfinite(np.hstack((obs["robot0_eef_pos"], obs["robot0_eef_quat"]))).all()
    env.close()
