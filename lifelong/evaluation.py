"""The evaluation loop: there is no other."""

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from libero_env.init_states import NUM_INIT_STATES
from lifelong.errors import ConfigError
from lifelong.nn.precision import autocast
from lifelong.policies.base import Policy
from lifelong.training import generator
from lifelong.types import Observation, PolicySpec

Obs = Mapping[str, np.ndarray]  # name -> (B, ...)


class VectorEnv(Protocol):
    """What a rollout needs of `libero_env.vector.BatchEnv`; finished simulations stand still."""

    num_envs: int

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]: ...

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class EvalSettings:
    """How success is measured; the defaults are the paper's, but for `selection`.

    Attributes:
        episodes: Rollouts per cell of the success matrix; they start in the first so many initial states.
        curve_episodes: Rollouts per point of a learning curve.
        every: Epochs between two points of a learning curve; it also has epoch 0 and the last one.
        horizon: Most control steps per episode.
        settle_steps: Steps with a zero action before the policy acts.
        selection: Initial states of the learning curve, by which the best epoch is chosen. `apart`: the last
            ones of the 50, which no reported number uses. `reporting`: those reported afterwards, as LIBERO
            does.
        select: Which weights are kept of a task: those of the `best` epoch, the earliest if several are, or
            the `last`.
        precision: See `FitSettings`.
        record_every: Control steps between two pictures of the recorded rollouts; 0 records none.
        open_environments: Environments kept open, of different tasks.
        sim_threads: Threads that step simulations; 0 takes all cores.
    """

    episodes: int = 20
    curve_episodes: int = 20
    every: int = 5
    horizon: int = 600
    settle_steps: int = 5
    selection: Literal["apart", "reporting"] = "apart"
    select: Literal["best", "last"] = "best"
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    record_every: int = 4
    open_environments: int = 4
    sim_threads: int = 0

    def __post_init__(self) -> None:
        for name, valid in (("selection", ("apart", "reporting")), ("select", ("best", "last"))):
            if getattr(self, name) not in valid:
                raise ConfigError(f"eval.{name} is {getattr(self, name)!r}; valid: {', '.join(valid)}")
        for name in ("episodes", "curve_episodes", "every", "horizon"):
            if getattr(self, name) < 1:
                raise ConfigError(f"eval.{name} is {getattr(self, name)}; it must be at least 1")
        needed = self.episodes + (self.curve_episodes if self.selection == "apart" else 0)
        if max(needed, self.curve_episodes) > NUM_INIT_STATES:
            raise ConfigError(
                f"eval.episodes={self.episodes} and eval.curve_episodes={self.curve_episodes} need {needed} "
                f"initial states, a task has {NUM_INIT_STATES}: lower one of them, or set "
                "eval.selection=reporting"
            )

    def init_states(self, phase: Literal["curve", "matrix"]) -> range:
        """Indices of the initial states that rollouts of a kind start in."""
        if phase == "matrix":
            return range(self.episodes)
        if self.selection == "reporting":
            return range(self.curve_episodes)
        return range(NUM_INIT_STATES - self.curve_episodes, NUM_INIT_STATES)

    def curve_epochs(self, epochs: int) -> tuple[int, ...]:
        """The epochs at which a learning curve has points."""
        return tuple(sorted({*range(0, epochs + 1, self.every), epochs}))


@dataclass(frozen=True)
class Episode:
    """The outcome of one rollout.

    Attributes:
        init_state: Index of the initial state it began in.
        success: Whether the goal was reached.
        length: Control steps the policy took, without those of settling.
    """

    init_state: int
    success: bool
    length: int


@dataclass(frozen=True)
class Rollouts:
    """Outcomes in the order asked for, and what was seen in the first of them."""

    episodes: tuple[Episode, ...]
    seconds: float
    frames: tuple[np.ndarray, ...] = field(default=(), repr=False)  # each (H, W, 3) uint8, upright

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
    """Let a policy act from given initial states, all at once.

    Each step is one call of the policy on all simulations. Finished ones keep their row, so that the numbers
    the others get do not depend on when they finished, but are neither stepped nor drawn.

    Args:
        policy: Put in evaluation mode; back in its old mode afterwards.
        env: As many simulations as initial states.
        init_states: Indices of stored initial states, one per simulation.
        language: (L,) embedding of the instruction.
        horizon: Most control steps of the policy per episode.
        settle_steps: Steps with a zero action before the policy acts, so that objects come to rest
            (LIBERO: 5).
        seed: Whole numbers from which a policy that acts at random gets a generator per episode.
        device: Where the policy is.
        precision: See `lifelong.training.FitSettings`.
        record_every: Keep every so many steps a picture of all cameras of the first simulation; 0 keeps none.
        label: Stands before the progress bar.
        progress: Show a progress bar.

    Raises:
        ConfigError: The number of simulations is not that of the initial states.
    """
    if env.num_envs != len(init_states):
        raise ConfigError(
            f"{len(init_states)} initial states, but the environment has {env.num_envs} simulations"
        )
    started, was_training, device = time.perf_counter(), policy.training, torch.device(device)
    draws = [generator(*seed, state) for state in init_states]
    observe = _Observer(policy.spec, language, device)
    policy.eval()
    policy.reset(env.num_envs)
    obs, _ = env.reset(options={"init_state": np.asarray(init_states)})
    success = np.zeros(env.num_envs, bool)
    over = np.zeros(env.num_envs, bool)
    for _ in range(settle_steps):
        obs, over, success = _step(env, np.zeros((env.num_envs, policy.spec.action_dim)), over, success)
    lengths, frames = np.zeros(env.num_envs, int), []
    bar = tqdm(range(horizon), desc=label, disable=not progress, unit="step", leave=False)
    with autocast(device, precision):
        for step in bar:
            if record_every and step % record_every == 0 and not over[0]:
                frames.append(_picture(obs, policy.spec))
            if over.all():
                break
            lengths += ~over
            actions = policy.act(observe(obs), draws).cpu().numpy().astype(np.float64)
            obs, over, success = _step(env, actions, over, success)
            bar.set_postfix(done=int(over.sum()), refresh=False)
    bar.close()
    policy.train(was_training)
    episodes = tuple(map(Episode, map(int, init_states), map(bool, success), map(int, lengths)))
    return Rollouts(episodes, time.perf_counter() - started, tuple(frames))


class EnvPool:
    """Environments by task, at most `capacity` of them open; the one not used for longest is closed first."""

    def __init__(self, make: Callable[[Any], VectorEnv], capacity: int = 4):
        """Make a pool.

        Args:
            make: Builds the environment of a key.
            capacity: Largest number of open environments.
        """
        self._make, self._capacity = make, max(1, capacity)
        self._open: OrderedDict[Hashable, VectorEnv] = OrderedDict()

    def get(self, key: Hashable) -> VectorEnv:
        """The environment of a key, built if it is not open."""
        if key not in self._open:
            while len(self._open) >= self._capacity:
                self._open.popitem(last=False)[1].close()
            self._open[key] = self._make(key)
        self._open.move_to_end(key)
        return self._open[key]

    def close(self) -> None:
        """Close all environments."""
        while self._open:
            self._open.popitem()[1].close()

    def __enter__(self) -> "EnvPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def save_animation(frames: Sequence[np.ndarray], path: Path, *, seconds_per_frame: float) -> None:
    """Write frames, each (H, W, 3) uint8, as an animated WebP that plays for ever."""
    path.parent.mkdir(parents=True, exist_ok=True)
    first, *rest = [Image.fromarray(frame) for frame in frames]
    first.save(
        path, save_all=True, append_images=rest, duration=round(1000 * seconds_per_frame), loop=0, quality=70
    )


@dataclass(frozen=True)
class _Observer:
    """Environment observations to what the policy takes."""

    spec: PolicySpec
    language: Tensor
    device: torch.device

    def __call__(self, obs: Obs) -> Observation:
        images = np.stack([obs[view] for view in self.spec.views], axis=1)[:, None]  # (B, 1, V, H, W, C)
        proprio = {
            name: torch.from_numpy(np.asarray(obs[name], np.float32))[:, None].to(self.device)
            for name in self.spec.proprio or ()
        }
        language = self.language.to(self.device).expand(len(images), -1)
        return Observation(torch.from_numpy(images).to(self.device), proprio, language)


def _step(
    env: VectorEnv, actions: np.ndarray, over: np.ndarray, success: np.ndarray
) -> tuple[Obs, np.ndarray, np.ndarray]:
    """Observation, which episodes are over, which of them with success."""
    obs, _, terminated, truncated, info = env.step(actions)
    success = success | (np.asarray(info["success"], bool) & ~over)
    return obs, over | terminated | truncated, success


def _picture(obs: Obs, spec: PolicySpec) -> np.ndarray:
    """All cameras of the first simulation side by side."""
    return np.concatenate([np.array(obs[view][0]) for view in spec.views], axis=1)
