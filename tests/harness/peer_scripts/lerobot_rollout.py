"""Run in LeRobot's environment: its `make_env` and `rollout` on the plug-in, with actions that were recorded before.

Arguments: file with `actions` (T, 7), `suite` and `index`; file that a repository of the Hub has as `env.py`.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.envs import make_env
from lerobot.envs.configs import LiberoEnv as OwnConfig
from lerobot.envs.factory import make_env_config
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins

SIZE = 64


class Replay(torch.nn.Module):
    """Answers with recorded actions, the same for every simulation, and keeps the observations."""

    def __init__(self, actions: np.ndarray):
        super().__init__()
        self.actions, self.step, self.seen = torch.from_numpy(actions), 0, []

    def reset(self) -> None:
        self.step = 0

    def select_action(self, batch: dict) -> torch.Tensor:
        self.seen.append(batch)
        action = self.actions[min(self.step, len(self.actions) - 1)]
        self.step += 1
        return action[None].repeat(len(batch["observation.state"]), 1)


def downloaded(file: Path, cache: Path) -> str:
    """Put a file where LeRobot finds `env.py` of a repository that it has downloaded; return the repository's name."""
    repository, commit = cache / "models--somebody--libero", 40 * "0"
    for path, text in (("refs/main", commit), (f"snapshots/{commit}/env.py", file.read_text())):
        (repository / path).parent.mkdir(parents=True)
        (repository / path).write_text(text)
    return "somebody/libero"


def main() -> None:
    register_third_party_plugins()  # what LeRobot's commands do; nothing imports the plug-in
    recorded = np.load(sys.argv[1])
    size = {"observation_height": SIZE, "observation_width": SIZE}
    suite, tasks = str(recorded["suite"]), [int(recorded["index"])]
    config = make_env_config("libero_lifelong", task=suite, task_ids=tasks, **size)
    hub = {"hub_cache_dir": "hub", "trust_remote_code": True}
    repository = downloaded(Path(sys.argv[2]), Path("hub"))
    everything = make_env(repository, n_envs=2, **hub)
    own = OwnConfig(**size)
    before, after = config.get_env_processors()
    policies, frames = [], []
    for config.hub_path in (repository, None):
        (env,) = make_env(config, n_envs=2, **hub)[suite].values()
        policies.append(Replay(recorded["actions"]))
        steps = (before, after, lambda batch: batch, lambda action: action)
        result = rollout(env, policies[-1], *steps, seeds=[1000, 1001])
        frames.append(np.stack(env.call("render")))
        env.close()
    first = policies[1].seen[0]
    found = {
        "type": config.type,
        "same_features": config.features == own.features and config.features_map == own.features_map,
        "success": result["success"].any(dim=1).tolist(),
        "steps": [int(row.int().argmax()) + 1 for row in result["success"]],
        "task": first["task"],
        "state": first["observation.state"][0].tolist(),
        "image": (first["observation.images.image"][0] * 255).round().int().flatten().tolist(),
        "frames": list(frames[1].shape),
        "hub_tasks": {suite: len(envs) for suite, envs in everything.items()},
        "hub_same": np.array_equal(*frames) and _equal(*(policy.seen for policy in policies)),
    }
    print(json.dumps(found))


def _equal(one: list[dict], other: list[dict]) -> bool:
    if len(one) != len(other):
        return False
    return all(
        torch.equal(a[key], b[key]) if isinstance(a[key], torch.Tensor) else a[key] == b[key]
        for a, b in zip(one, other, strict=True)
        for key in a
    )


if __name__ == "__main__":
    main()
