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
    recordings = [_Recording() for _ in experts]
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
            recordings[i].states.append(env.simulations.physics_state(i))
            recordings[i].actions.append(actions[i].copy())
            recordings[i].expert_actions.append(action)
        success = env.step(actions)[-1]["success"][: len(experts)]
    for i, recording in enumerate(recordings):
        recording.states.append(env.simulations.physics_state(i))
    fixtures = env.simulations.fixtures
    return [
        recordings[i].attempt(expert, bool(success[i]), fixtures[i].copy())
        for i, expert in enumerate(experts)
    ]


@dataclass
class _Recording:
    """What an attempt consists of so far."""

    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    expert_actions: list[np.ndarray] = field(default_factory=list)

    def attempt(self, expert: Expert, success: bool, fixtures: np.ndarray) -> Attempt:
        """Return the attempt at its end."""
        reason = f"in phase {expert.phase} after {len(self.actions)} steps, {expert.retries} retries"
        return Attempt(
            success=success,
            states=np.array(self.states),
            actions=np.array(self.actions),
            expert_actions=np.array(self.expert_actions),
            retries=expert.retries,
            reason="" if success else expert.failure_reason or reason,
            fixtures=fixtures,
        )
