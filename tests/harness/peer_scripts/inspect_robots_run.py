"""Run in Inspect Robots' environment: its `eval` on the embodiment that it finds.

python inspect_robots_run.py TASK EMBODIMENT POLICY SEEN

TASK and EMBODIMENT have options of those named `libero`, as JSON; POLICY is a file with `actions` (T, 7), or the folder
of a run; SEEN is where all that the policy saw and answered is written.
"""

import json
import sys
from pathlib import Path

import numpy as np
from inspect_robots import eval as evaluate
from inspect_robots.conformance import assert_embodiment_conformant
from inspect_robots.controller import DefaultController
from inspect_robots.policy import PolicyBase, PolicyInfo
from inspect_robots.registry import registered, resolve
from inspect_robots.types import Action, ActionChunk


class Replay(PolicyBase):
    """Answers with recorded actions, the first again after the last."""

    def __init__(self, actions: np.ndarray, space):
        self.info = PolicyInfo("replay", space)
        self.actions, self.step = actions, 0

    def reset(self, scene) -> None:
        self.step = 0

    def act(self, observation) -> ActionChunk:
        self.step += 1
        return ActionChunk([Action(self.actions[(self.step - 1) % len(self.actions)])])


class Keep(DefaultController):
    """Keeps what the policy sees and answers."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def next_action(self, policy, observation, t, store):
        action = super().next_action(policy, observation, t, store)
        arrays = {**observation.images, **observation.state, "action": action.data}
        self.seen.append({**arrays, "t": t})
        return action


def main() -> None:
    task, embodiment = (json.loads(options) for options in sys.argv[1:3])
    policy_path, seen = Path(sys.argv[3]), sys.argv[4]
    embodiment = resolve("embodiment", "libero", **embodiment)
    assert_embodiment_conformant(embodiment.info)
    if policy_path.is_dir():
        policy = resolve("policy", "libero_run", run=str(policy_path), device="cpu")
    else:
        policy = Replay(np.load(policy_path)["actions"], embodiment.info.action_space)
    keep = Keep()
    (log,) = evaluate(resolve("task", "libero", **task), policy, embodiment, controller=keep, log_dir="logs")
    embodiment.close()
    if keep.seen:
        np.savez(seen, **{key: np.array([step[key] for step in keep.seen]) for key in keep.seen[0]})
    print(
        json.dumps(
            {
                "registered": {kind: sorted(registered(kind)) for kind in ("task", "embodiment", "policy")},
                "errors": [sample.error for sample in log.samples if sample.error],
                "metrics": log.results.metrics,
                "instructions": [sample.instruction for sample in log.samples],
                "scenes": [sample.scene_id for sample in log.samples],
            }
        )
    )


if __name__ == "__main__":
    main()
