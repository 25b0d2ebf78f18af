"""Evaluations whose outcomes are known: no simulator, and a policy that stands still."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np

from libero_env.tasks import get_suite
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.protocols.clock import ClockedActor
from libero_eval.protocols.files import load_protocol
from libero_eval.user_policy import CallableActor
from libero_eval.work.evaluation import Evaluation
from libero_eval.work.worker import Worker

TASKS = get_suite("libero_goal").tasks[:2]
_SHORT = {"episode.horizon": 10, "episode.settle_steps": 0, "episode.settle_action": None}
QUICK = load_protocol("libero").changed(_SHORT)


class Countdown:
    """Simulation i succeeds after as many steps as the index of its initial state; its goal has two atoms."""

    atoms = ("(Turnon stove_1)", "(On pot_1 stove_1)")

    def __init__(self, num_envs: int):
        self.num_envs = num_envs

    def reset(self, *, seed=None, options=None):
        self.goal, self.steps = np.asarray(options["init_state"]), 0
        return {"x": np.zeros((self.num_envs, 1))}, self._info()

    def _info(self):
        done = self.steps >= self.goal
        return {"success": done, "progress": np.stack([2 * self.steps >= self.goal, done], 1)}

    def step(self, actions):
        self.steps += 1
        reached = self.steps == self.goal
        obs, truncated = {"x": np.zeros((self.num_envs, 1))}, np.zeros(self.num_envs, bool)
        return obs, reached, reached, truncated, self._info()

    def close(self):
        pass


class Still:
    def __init__(self):
        self.instructions = []

    def predict(self, observations):
        self.instructions.append(observations["instruction"])
        return np.zeros((len(observations["x"]), 7))


def evaluation(out: Path, policy=None, **changes) -> Evaluation:
    policy = policy or Still()

    @contextmanager
    def actor(task, states):
        yield ClockedActor(CallableActor(policy, (), task.language))

    arguments = {
        "identity": {"policy": "still"}, "tasks": TASKS, "init_states": (3, 4, 9, 20), "protocol": QUICK,
        "env": lambda task, count: Countdown(count), "versions": {"mujoco": "3"}
    }  # fmt: skip
    return Evaluation(out=out, actor=actor, **(arguments | changes))


def evaluate(out: Path, policy=None, **changes) -> EvaluationResult:
    """Evaluate in this process, quietly."""
    return Worker(evaluation(out, policy, **changes), on_error=lambda _: None).run()


def write_policy(path: Path, predicted: str, *own: str) -> None:
    """Write a module whose `make` is a policy with lines of its own; it notes what it is told in told.txt."""
    lines = "\n    ".join(own or ("pass",))
    path.write_text(f"""
import numpy as np


class make:
    {lines}

    def reset(self, instruction, num_envs):
        with open("told.txt", "a") as file:
            print(instruction, file=file)

    def predict(self, observations):
        return {predicted}
""")
