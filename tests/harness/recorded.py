"""Actions that solve a task from one of its stored states, for policies that replay them elsewhere."""

from pathlib import Path

import numpy as np

from libero_env.envs.env import LiberoEnv
from libero_env.expert.expert import Expert
from libero_env.tasks import get_task

OPEN = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


def solve(task: str, start: int, *, settle_steps: int = 10) -> np.ndarray:
    """Return the expert's actions (T, 7) float32, as protocols transport them, after steps with the gripper opened."""
    env = LiberoEnv(task, cameras=(), assets="builtin")
    try:
        env.reset(options={"init_state": start})
        for _ in range(settle_steps):
            env.step(OPEN)
        expert, actions = Expert(env.task, np.random.default_rng(0)), []
        terminated = False
        while not terminated:
            assert not expert.failure_reason and len(actions) < 500
            actions.append(np.asarray(expert.act(env.view), np.float32))
            terminated = env.step(actions[-1])[2]
    finally:
        env.close()
    return np.array(actions)


def write_actions(path: Path, task: str, start: int) -> Path:
    """Write what `solve` returns, with `suite`, `index` and `start`."""
    found = get_task(task)
    np.savez(path, actions=solve(task, start), suite=found.suite, index=found.index, start=start)
    return path
