"""Run in LeRobot's environment: its `make_env` and `rollout` on the plug-in, with actions that were recorded before.

Argument: file with `actions` (T, 7), `suite` and `index`.
"""

import json
import sys

import numpy as np
import torch
from lerobot.envs import make_env
from lerobot.envs.configs import LiberoEnv as OwnConfig
from lerobot.envs.factory import make_env_config
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins

SIZE = 64


class Replay(torch.nn.Module):
    """Answers with recorded actions, the same for every simulation, and keeps the first observation."""

    def __init__(self, actions: np.ndarray):
        super().__init__()
        self.actions, self.step, self.first = torch.from_numpy(actions), 0, None

    def reset(self) -> None:
        self.step = 0

    def select_action(self, batch: dict) -> torch.Tensor:
        if self.step == 0:
            self.first = batch
        action = self.actions[min(self.step, len(self.actions) - 1)]
        self.step += 1
        return action[None].repeat(len(batch["observation.state"]), 1)


def main() -> None:
    register_third_party_plugins()  # what LeRobot's commands do; nothing imports the plug-in
    recorded = np.load(sys.argv[1])
    config = make_env_config(
        "libero_lifelong",
        task=str(recorded["suite"]),
        task_ids=[int(recorded["index"])],
        observation_height=SIZE,
        observation_width=SIZE,
    )
    own = OwnConfig(observation_height=SIZE, observation_width=SIZE)
    (env,) = make_env(config, n_envs=2)[str(recorded["suite"])].values()
    policy = Replay(recorded["actions"])
    before, after = config.get_env_processors()
    result = rollout(
        env, policy, before, after, lambda batch: batch, lambda action: action, seeds=[1000, 1001]
    )
    frames = np.stack(env.call("render"))
    env.close()
    print(
        json.dumps(
            {
                "type": config.type,
                "same_features": config.features == own.features and config.features_map == own.features_map,
                "success": result["success"].any(dim=1).tolist(),
                "steps": [int(row.int().argmax()) + 1 for row in result["success"]],
                "task": policy.first["task"],
                "state": policy.first["observation.state"][0].tolist(),
                "image": (policy.first["observation.images.image"][0] * 255).round().int().flatten().tolist(),
                "frames": list(frames.shape),
            }
        )
    )


if __name__ == "__main__":
    main()
