"""A policy's own episodes: how their actions are drawn, and what is kept to learn from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lifelong.evaluation.actors import observe
from lifelong.evaluation.environments import Obs, VectorEnv
from lifelong.evaluation.rollout import run_episodes
from lifelong.nn.heads import GMMHead
from lifelong.policies.base import in_mode
from lifelong.policies.history import HistoryPolicy
from lifelong.training.precision import autocast, float32_products
from lifelong.types import Batch


@dataclass(frozen=True, kw_only=True)
class Experience(Batch):
    """Frames of a policy's own episodes, with the actions that were drawn, before they were clipped to [-1, 1].

    Attributes:
        log_probs: Log-probability of each action when it was drawn, (B,) float32; NaN for frames of demonstrations.
        advantages: By how much its episode was better than others from the same start, (B,) float32.
    """

    log_probs: Tensor
    advantages: Tensor

    def map(self, change: Any) -> "Experience":
        """Return the experience with every tensor changed."""
        changed = {name: change(getattr(self, name)) for name in ("log_probs", "advantages")}
        return replace(cast(Experience, super().map(change)), **changed)

    def join(self, *others: Batch) -> "Experience":
        """Return this experience followed by more, or by demonstrations, on its device."""
        others = tuple(one.to(self.actions.device) for one in others)
        of_others = [
            (one.log_probs, one.advantages)
            if isinstance(one, Experience)
            else (self.log_probs.new_full((len(one),), torch.nan), self.advantages.new_zeros(len(one)))
            for one in others
        ]
        log_probs, advantages = zip((self.log_probs, self.advantages), *of_others, strict=True)
        joined = cast(Experience, super().join(*others))
        return replace(joined, log_probs=torch.cat(log_probs), advantages=torch.cat(advantages))


@dataclass(frozen=True)
class Collected:
    """What a policy saw and did in E episodes.

    Attributes:
        frames: All frames, step after step; their advantages are zero.
        episode: The episode that each frame is of, (F,) int64.
        rewards: 1 for success and 0 for failure, NaN where a simulation has failed, (E,) float32.
    """

    frames: Experience
    episode: Tensor
    rewards: Tensor

    def join(self, *others: "Collected") -> "Collected":
        """Return these episodes followed by others."""
        if not others:
            return self
        parts = (self, *others)
        starts = np.cumsum([0, *(len(part.rewards) for part in parts)]).tolist()
        return Collected(
            self.frames.join(*(part.frames for part in others)),
            torch.cat([part.episode + start for part, start in zip(parts, starts, strict=False)]),
            torch.cat([part.rewards for part in parts]),
        )


class DrawingActor:
    """A policy whose actions are drawn from its mixture, all simulations' from one generator; it keeps the frames.

    Args:
        policy: Policy of single frames with a mixture, in evaluation mode.
        language: (L,) embedding of the instruction.
        task: Position of the task.
    """

    def __init__(
        self, policy: HistoryPolicy, language: Tensor, task: int, precision: str, draws: torch.Generator
    ):
        self.policy, self.precision, self.draws = policy, precision, draws
        self.language, self.task = language, task
        self.device = next(policy.parameters()).device
        self.frames: list[Experience] = []
        self.episode: list[Tensor] = []
        self._running = torch.zeros(0, dtype=torch.int64)

    action_dim = property(lambda self: self.policy.spec.action_dim)
    views = property(lambda self: self.policy.spec.views)

    def reset(self, num_envs: int) -> None:
        """Reset the history; see `lifelong.evaluation.actors.Actor`."""
        self.policy.reset(num_envs)

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of the episodes that are over, whose frames are not kept any more."""
        self._running = torch.from_numpy(np.flatnonzero(~over))

    @torch.no_grad()
    def act(self, obs: Obs) -> np.ndarray:
        """Draw (B, A) float64 actions, and keep what the running simulations see and do."""
        head, running = self.policy.head, self._running
        assert isinstance(head, GMMHead)
        seen = observe(obs, self.policy.spec, self.language, self.device)
        with autocast(self.device, self.precision), float32_products(self.precision):
            params = {name: value.cpu() for name, value in self.policy.step(seen).items()}
        actions = head.sample(params, self.draws)
        kept = seen.to("cpu").map(lambda x: x[running])
        frames = Experience(
            observation=kept,
            actions=actions[running, None],
            task_ids=torch.full_like(running, self.task),
            window_ids=torch.zeros_like(running),
            log_probs=head.log_prob(params, actions)[running],
            advantages=torch.zeros(len(running)),
        )
        self.frames.append(frames)
        self.episode.append(running)
        return actions.clamp(-1.0, 1.0).double().numpy()


def collect(
    policy: HistoryPolicy,
    env: VectorEnv,
    starts: Sequence[int],
    *,
    language: Tensor,
    task: int,
    horizon: int,
    settle_steps: int,
    precision: str,
    draws: torch.Generator,
) -> Collected:
    """Run an episode from each start, with drawn actions.

    Args:
        policy: Policy of single frames with a mixture.
        env: Environment with one simulation for each start.
        starts: Seeds of the initial states; equal seeds are equal states.
        language: (L,) embedding of the instruction.
        task: Position of the task.
        horizon: Maximum number of control steps.
        settle_steps: Number of steps before the policy acts.
        precision: Precision of the policy.
        draws: CPU generator of the actions.
    """
    actor = DrawingActor(policy, language, task, precision, draws)
    with in_mode(policy, training=False):
        done = run_episodes(
            actor, env, range(len(starts)), seeds=starts, horizon=horizon, settle_steps=settle_steps
        )
    rewards = [torch.nan if e.simulation_error else float(e.success) for e in done.episodes]
    first, *rest = actor.frames
    return Collected(first.join(*rest), torch.cat(actor.episode), torch.tensor(rewards))
