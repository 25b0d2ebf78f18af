"""LeRobot itself evaluates a policy that was learned here: its rollout beside the run's own records.

    .venv-lerobot/bin/python experiments/lerobot/stock_rollout.py runs/libero_object/er/lerobot_seed1 --task 0

The policy and its processors are read by LeRobot from `lerobot/` in the run's directory, and LeRobot's `rollout` moves
simulations of this package with them, from the starts of the run's last evaluation of the task.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import yaml

from libero_env import LiberoEnv
from libero_integrations.lerobot_modules import lerobot_module
from libero_integrations.lerobot_policy import EMBEDDING, FOLDER, IMAGES
from lifelong.language import embed


class ForLeRobot(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A task as LeRobot's rollout takes it: named pictures, one state, and whether the last step succeeded.

    Args:
        task: The task.
        start: Index of the initial state.
        settings: The run's configuration.
        embedding: What the policy reads as the instruction, (L,); None if it reads none.
    """

    def __init__(self, task: str, start: int, settings: dict[str, Any], embedding: np.ndarray | None):
        data = settings["data"]
        self._max_episode_steps = settings["eval"]["horizon"] + settings["eval"]["settle_steps"]
        self.env = LiberoEnv(task, camera_size=(data["image_size"],) * 2, horizon=self._max_episode_steps)
        self.start, self.views, self.readings = start, data["views"], data["proprio"]
        self.embedding, self.task_description = embedding, self.env.task.language
        self.task = self.task_description
        self.action_space = self.env.action_space
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pixels": gymnasium.spaces.Dict(
                    {_last(view): self.env.observation_space[view] for view in self.views}
                ),
                "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (self._state(self._read()).size,)),
                **(
                    {}
                    if embedding is None
                    else {"environment_state": gymnasium.spaces.Box(-np.inf, np.inf, embedding.shape)}
                ),
            }
        )

    def _read(self) -> dict[str, np.ndarray]:
        return self.env.reset(options={"init_state": self.start})[0]

    def _state(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([seen[name] for name in self.readings]).astype(np.float32)

    def _given(self, seen: dict[str, np.ndarray]) -> dict[str, Any]:
        given = {"pixels": {_last(view): seen[view] for view in self.views}, "agent_pos": self._state(seen)}
        return given if self.embedding is None else {**given, "environment_state": self.embedding}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Return the observation of the start."""
        return self._given(self._read()), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make a step; its end is told as LeRobot expects it."""
        seen, reward, terminated, truncated, info = self.env.step(np.clip(action, -1, 1))
        told: dict[str, Any] = {"is_success": bool(info["success"])}
        if terminated or truncated:
            told["final_info"] = {"is_success": bool(info["success"])}
        return self._given(seen), float(reward), bool(terminated), bool(truncated), told


def _last(view: str) -> str:
    return IMAGES[view].rpartition(".")[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--task", type=int, default=0, help="position in the sequence")
    parser.add_argument("--starts", type=int, default=100, help="at most so many starts")
    args = parser.parse_args()
    settings = yaml.safe_load((args.run / "config.yaml").read_text())
    records = [json.loads(line) for line in (args.run / "results.jsonl").read_text().splitlines()]
    (begun,) = [r for r in records if r["kind"] == "run"][:1]
    cells = [
        r
        for r in records
        if r["kind"] == "eval" and r["phase"] == "matrix" and r["task"] == args.task and not r["shift"]
    ]
    own = max(cells, key=lambda record: record["learned"])
    factory, configs = lerobot_module("policies.factory"), lerobot_module("configs.policies")
    rollout = lerobot_module("scripts.lerobot_eval").rollout
    folder = args.run / FOLDER
    config = configs.PreTrainedConfig.from_pretrained(folder)
    policy = factory.get_policy_class(config.type).from_pretrained(folder, config=config).eval()
    before, after = factory.make_pre_post_processors(config, pretrained_path=str(folder))
    embedding = None
    if EMBEDDING in config.input_features:
        embedding = embed([begun["instructions"][args.task]], settings["language"]["model"])[0].numpy()
    task, starts = f"{begun['benchmark']}/{args.task}", own["init_states"][: args.starts]
    env = gymnasium.vector.SyncVectorEnv(
        [
            lambda start=start: ForLeRobot(begun["tasks"][args.task], start, settings, embedding)
            for start in starts
        ]
    )
    same = lambda values: values  # noqa: E731
    found = rollout(env, policy, same, same, before, after, seeds=[0] * len(starts))
    success = found["success"].any(dim=1).tolist()
    steps = [int(row.int().argmax()) + 1 if row.any() else len(row) for row in found["done"]]
    theirs, ours = np.array(success), np.array(own["successes"][: len(starts)])
    print(
        f"{task}: LeRobot's rollout {theirs.mean():.0%}, the run {ours.mean():.0%}, of {len(starts)} starts"
    )
    print(
        f"the same outcome in {(theirs == ours).sum()}, the same number of steps in "
        f"{(np.array(steps) == np.array(own['lengths'][: len(starts)])).sum()}"
    )


if __name__ == "__main__":
    main()
