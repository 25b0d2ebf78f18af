"""The evaluation loop: there is no other."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Actor, Obs, PolicyActor
from lifelong.evaluation.environments import VectorEnv
from lifelong.policies.base import Policy
from lifelong.seeding import generator


@dataclass(frozen=True)
class Episode:
    """The outcome of one rollout.

    Attributes:
        init_state: Index of the initial state it began in.
        success: Whether the goal was reached.
        length: Control steps the policy took, without those of settling.
        at_start, ever, at_end: Which of the goal's atoms held before the policy acted, at any time from then on,
            and at the end; empty where the environment does not say.
    """

    init_state: int
    success: bool
    length: int
    at_start: tuple[bool, ...] = ()
    ever: tuple[bool, ...] = ()
    at_end: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Rollouts:
    """Outcomes in the order asked for, and what was seen in some of them.

    Attributes:
        episodes: One for each simulation.
        seconds: Wall time.
        atoms: The parts of the goal, as in the episodes.
        films: Of each recorded simulation its frames, (H, W, 3) uint8, upright.
    """

    episodes: tuple[Episode, ...]
    seconds: float
    atoms: tuple[str, ...] = ()
    films: tuple[tuple[np.ndarray, ...], ...] = field(default=(), repr=False)

    @property
    def frames(self) -> tuple[np.ndarray, ...]:
        """What was seen in the first recorded simulation."""
        return self.films[0] if self.films else ()

    @property
    def rate(self) -> float:
        """Share of successes."""
        return sum(e.success for e in self.episodes) / len(self.episodes)


def rollout(
    policy: Policy,
    env: VectorEnv,
    init_states: Sequence[int],
    *,
    language: Tensor,
    horizon: int,
    settle_steps: int = 5,
    seed: Sequence[int] = (0,),
    device: torch.device | str = "cpu",
    precision: str = "auto",
    record_every: int = 0,
    label: str = "",
    progress: bool = False,
) -> Rollouts:
    """Let a policy act from given initial states, all at once; see `play`.

    Args:
        policy: Put in evaluation mode; back in its old mode afterwards.
        env: As many simulations as initial states.
        init_states: Indices of stored initial states, one per simulation.
        language: (L,) embedding of the instruction.
        horizon, settle_steps, record_every, label, progress: See `play`.
        seed: Whole numbers from which a policy that acts at random gets a generator per episode.
        device: Where the policy is.
        precision: See `lifelong.training.settings.FitSettings`.

    Raises:
        ConfigError: The number of simulations is not that of the initial states.
    """
    draws = [generator(*seed, state) for state in init_states]
    was_training = policy.training
    policy.eval()
    try:
        return play(
            PolicyActor(policy, language, torch.device(device), precision, draws),
            env,
            init_states,
            horizon=horizon,
            settle_steps=settle_steps,
            record_every=record_every,
            label=label,
            progress=progress,
        )
    finally:
        policy.train(was_training)


def play(
    actor: Actor,
    env: VectorEnv,
    init_states: Sequence[int],
    *,
    horizon: int,
    settle_steps: int = 5,
    settle_action: Sequence[float] | None = None,
    record_every: int = 0,
    recorded: Sequence[int] = (0,),
    label: str = "",
    progress: bool = False,
) -> Rollouts:
    """Let an actor act from given initial states, all at once.

    Each step is one call of the actor on all simulations. Finished ones keep their row, so that the numbers
    the others get do not depend on when they finished, but are neither stepped nor drawn.

    Args:
        actor: Answers observations.
        env: As many simulations as initial states.
        init_states: Indices of stored initial states, one per simulation.
        horizon: Most control steps of the actor per episode.
        settle_steps: Steps before the actor acts, so that objects come to rest (LIBERO: 5).
        settle_action: What is done in them; nothing by default.
        record_every: Keep every so many steps a picture of all cameras of the recorded simulations; 0 keeps none.
        recorded: Positions of these simulations.
        label: Stands before the progress bar.
        progress: Show a progress bar.

    Raises:
        ConfigError: The number of simulations is not that of the initial states.
    """
    if env.num_envs != len(init_states):
        raise ConfigError(
            f"{len(init_states)} initial states, but the environment has {env.num_envs} simulations"
        )
    started = time.perf_counter()
    actor.reset(env.num_envs)
    obs, info = env.reset(options={"init_state": np.asarray(init_states)})
    watch = _Watch(env, info)
    still = np.zeros(actor.action_dim) if settle_action is None else np.asarray(settle_action, float)
    for _ in range(settle_steps):
        obs = watch.step(np.tile(still, (env.num_envs, 1)))
    watch.begin()
    lengths = np.zeros(env.num_envs, int)
    films: list[list[np.ndarray]] = [[] for _ in (recorded if record_every else ())]
    bar = tqdm(range(horizon), desc=label, disable=not progress, unit="step", leave=False)
    for step in bar:
        for film, i in zip(films, recorded, strict=False):
            if step % record_every == 0 and not watch.over[i]:
                film.append(_picture(obs, actor.views, i))
        if watch.over.all():
            break
        lengths += ~watch.over
        obs = watch.step(actor.act(obs))
        bar.set_postfix(done=int(watch.over.sum()), refresh=False)
    bar.close()
    episodes = watch.episodes(init_states, lengths)
    return Rollouts(episodes, time.perf_counter() - started, watch.atoms, tuple(map(tuple, films)))


def save_animation(frames: Sequence[np.ndarray], path: Path, *, seconds_per_frame: float) -> None:
    """Write frames, each (H, W, 3) uint8, as an animated WebP that plays for ever."""
    path.parent.mkdir(parents=True, exist_ok=True)
    first, *rest = [Image.fromarray(frame) for frame in frames]
    first.save(
        path, save_all=True, append_images=rest, duration=round(1000 * seconds_per_frame), loop=0, quality=70
    )


class _Watch:
    """Steps an environment and notes which episodes are over, how, and what of the goal was reached."""

    def __init__(self, env: VectorEnv, info: Mapping[str, Any]):
        self._env = env
        self.atoms: tuple[str, ...] = tuple(getattr(env, "atoms", ()))
        self.over, self.success = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
        self._now = self._progress(info)
        self._start = self._ever = self._now

    def begin(self) -> None:
        """What holds now is what the actor found."""
        self._start = self._ever = self._now

    def step(self, actions: np.ndarray) -> Obs:
        obs, _, terminated, truncated, info = self._env.step(actions)
        self.success = self.success | (np.asarray(info["success"], bool) & ~self.over)
        self._now = np.where(self.over[:, None], self._now, self._progress(info))
        self._ever = self._ever | self._now
        self.over = self.over | terminated | truncated
        return obs

    def episodes(self, init_states: Sequence[int], lengths: np.ndarray) -> tuple[Episode, ...]:
        """The outcome of each simulation."""
        atoms = [list(map(tuple, a.tolist())) for a in (self._start, self._ever, self._now)]
        rows = zip(map(int, init_states), self.success.tolist(), lengths.tolist(), *atoms, strict=True)
        return tuple(Episode(*row) for row in rows)

    def _progress(self, info: Mapping[str, Any]) -> np.ndarray:
        """(B, atoms) bool."""
        shape = (self._env.num_envs, len(self.atoms))
        return np.asarray(info["progress"], bool).reshape(shape) if self.atoms else np.zeros(shape, bool)


def _picture(obs: Obs, views: Sequence[str], i: int) -> np.ndarray:
    """All cameras of a simulation side by side."""
    return np.concatenate([np.array(obs[view][i]) for view in views], axis=1)
