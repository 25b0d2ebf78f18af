"""LeRobot itself, in an environment of its own: it finds the plug-in, and its rollouts see and do what ours do."""

import numpy as np
import pytest

from libero_env.envs.env import LiberoEnv
from tests.harness.peers import INTEGRATIONS, lerobot
from tests.harness.recorded import OPEN, write_actions

pytestmark = [pytest.mark.sim, pytest.mark.slow]

SIZE = 64


def test_lerobot_finds_the_plugin_and_its_rollout_succeeds(tmp_path):
    peer = lerobot()
    file = write_actions(tmp_path / "actions.npz", "libero_object/0", 0)
    env_file = INTEGRATIONS / "lerobot_env_libero_lifelong" / "env.py"
    found = peer.run("lerobot_rollout.py", file, env_file, cwd=tmp_path, LIBERO_ASSETS="builtin")
    assert found["hub_same"] and sum(found["hub_tasks"].values()) == 130
    assert found["type"] == "libero_lifelong" and found["same_features"]
    assert found["success"][0] and found["steps"][0] == len(np.load(file)["actions"])
    assert found["task"] == ["pick up the alphabet soup and place it in the basket"] * 2
    assert found["frames"] == [2, SIZE, SIZE, 3]
    options = {"assets": "builtin", "drawing": "faithful", "observed": "substep"}
    env = LiberoEnv(
        "libero_object/0",
        camera_size=(SIZE, SIZE),
        observations=("rgb", "proprioception", "ee_quat"),
        **options,
    )
    obs, _ = env.reset(options={"init_state": 0})
    for _ in range(10):
        obs, *_ = env.step(OPEN)
    env.close()
    mirrored = obs["agentview_rgb"][:, ::-1].transpose(2, 0, 1)  # upright, as LeRobot's processor turns it
    np.testing.assert_array_equal(np.reshape(found["image"], (3, SIZE, SIZE)), mirrored)
    state = np.array(found["state"])
    np.testing.assert_allclose(state[:3], obs["ee_pos"], atol=1e-6)
    np.testing.assert_allclose(np.abs(state[3:6]), np.abs(obs["ee_ori"]), atol=1e-5)
    np.testing.assert_allclose(state[6:], obs["gripper_states"], atol=1e-6)
