"""Experts beside a batch of simulations: one attempt in each, recorded as it goes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.expert.expert import Expert
from libero_env.expert.variation import ActionNoise

MAX_STEPS = 600


@dataclass(frozen=True)
class Attempt:
    """What happened in one simulation."""

    success: bool
    states: np.ndarray  # (T + 1, 1 + nq + nv) [time, qpos, qvel] before each action, and at the end
    actions: np.ndarray  # (T, 7) executed
    expert_actions: np.ndarray  # (T, 7) wanted
    retries: int
    reason: str  # why it did not succeed, or ""
    fixtures: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))  # (nfixtures, 7) pos, quat wxyz

    def __len__(self) -> int:
        return len(self.actions)


def run_experts(
    env: BatchEnv,
    experts: Sequence[Expert],
    disturbances: Sequence[ActionNoise | None] | None = None,
    *,
    max_steps: int = MAX_STEPS,
) -> list[Attempt]:
    """Let each expert act in the simulation of the same index until the goal holds, it gives up or the steps are over.

    What happens in a simulation depends on its own start, expert and disturbance alone.

    Args:
        env: after `reset`; simulations beyond the number of experts stand still.
        experts: one for each of the first simulations.
        disturbances: of the executed actions; None for none.
        max_steps: of each attempt.
    """
    disturbances = disturbances or [None] * len(experts)
    world = env.world
    states: list[list[np.ndarray]] = [[] for _ in experts]
    executed: list[list[np.ndarray]] = [[] for _ in experts]
    wanted: list[list[np.ndarray]] = [[] for _ in experts]
    success = np.zeros(len(experts), bool)
    for _ in range(max_steps):
        live = [i for i in np.flatnonzero(env.running) if i < len(experts) and not experts[i].failure_reason]
        if not live:
            break
        actions = np.zeros((env.num_envs, 7))
        for i in live:
            label = experts[i].act(world.views[i])
            noise = disturbances[i]
            actions[i] = label if noise is None else noise.apply(label, experts[i].noise_scale)
            states[i].append(world.physics_state(i))
            executed[i].append(actions[i].copy())
            wanted[i].append(label)
        success = env.step(actions)[-1]["success"][: len(experts)]
    for i, rows in enumerate(states):
        rows.append(world.physics_state(i))
    return [
        Attempt(
            bool(success[i]),
            np.array(states[i]),
            np.array(executed[i]),
            np.array(wanted[i]),
            expert.retries,
            "" if success[i] else _reason(expert, len(executed[i])),
            world.simulations.fixtures[i].copy(),
        )
        for i, expert in enumerate(experts)
    ]


def _reason(expert: Expert, steps: int) -> str:
    return expert.failure_reason or f"in phase {expert.phase} after {steps} steps, {expert.retries} retries"
