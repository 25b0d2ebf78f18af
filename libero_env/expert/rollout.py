"""Experts in a batch of simulations: one attempt in each, recorded as it proceeds."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.expert.expert import Expert
from libero_env.expert.variation import ActionNoise

MAX_STEPS = 600  # control steps of an attempt


@dataclass(frozen=True)
class Attempt:
    """What happened in one simulation.

    Attributes:
        success: Whether the goal was reached.
        states: [time, qpos, qvel] before each action and at the end, (T + 1, 1 + nq + nv).
        actions: Executed actions, (T, 7).
        expert_actions: Actions of the expert, without noise, (T, 7).
        retries: Number of times that the expert began again.
        reason: Why the attempt did not succeed, or "".
        fixtures: Poses of the fixtures, (nfixtures, 7): position, [m], and quaternion wxyz.
    """

    success: bool
    states: np.ndarray
    actions: np.ndarray
    expert_actions: np.ndarray
    retries: int
    reason: str
    fixtures: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))

    def __len__(self) -> int:
        return len(self.actions)


def run_experts(
    env: BatchEnv,
    experts: Sequence[Expert],
    noise: Sequence[ActionNoise | None] | None = None,
    *,
    max_steps: int = MAX_STEPS,
) -> list[Attempt]:
    """Let experts act in a batch of simulations.

    An attempt ends when the goal holds, when the expert gives up, or after the largest number of steps. It depends on
    the start, the expert and the noise of its own simulation only.

    Args:
        env: Environment after `reset`; simulations beyond the number of experts stand still.
        experts: Experts of the first simulations, one each.
        noise: Noise on the executed actions of each expert, or None; no noise at all if None.
        max_steps: Largest number of steps of an attempt.

    Returns:
        One attempt for each expert, in order.
    """
    noise = noise or [None] * len(experts)
    states: list[list[np.ndarray]] = [[] for _ in experts]  # of each simulation, step by step
    executed: list[list[np.ndarray]] = [[] for _ in experts]
    chosen: list[list[np.ndarray]] = [[] for _ in experts]
    success = np.zeros(len(experts), bool)
    for _ in range(max_steps):
        running = map(int, np.flatnonzero(env.running[: len(experts)]))
        live = [i for i in running if not experts[i].failure_reason]
        if not live:
            break
        actions = np.zeros((env.num_envs, 7))
        for i in live:
            action, own_noise = experts[i].act(env.views[i]), noise[i]
            actions[i] = action if own_noise is None else own_noise.apply(action, experts[i].noise_scale)
            states[i].append(env.simulations.physics_state(i))
            executed[i].append(actions[i].copy())
            chosen[i].append(action)
        success = env.step(actions)[-1]["success"][: len(experts)]
    return [
        Attempt(
            success=bool(success[i]),
            states=np.array([*states[i], env.simulations.physics_state(i)]),
            actions=np.array(executed[i]),
            expert_actions=np.array(chosen[i]),
            retries=expert.retries,
            reason="" if success[i] else expert.failure_reason or _last_phase(expert, len(executed[i])),
            fixtures=env.simulations.fixtures[i].copy(),
        )
        for i, expert in enumerate(experts)
    ]


def _last_phase(expert: Expert, steps: int) -> str:
    return f"in phase {expert.phase} after {steps} steps, {expert.retries} retries"
