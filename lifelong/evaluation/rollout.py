"""The evaluation loop. The package has no other."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from libero_env.errors import SimulationError
from libero_env.progress import progress_bar
from libero_env.sim.causes import Failure
from libero_env.sim.costs import Costs
from libero_env.sim.watch import EpisodeWatch
from libero_env.storage import atomic_path
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Actor, Hears, PolicyActor, TakesNote
from lifelong.evaluation.environments import Obs, VectorEnv
from lifelong.seeding import generator

if TYPE_CHECKING:  # judging needs no PyTorch
    import torch
    from torch import Tensor

    from lifelong.policies.base import Policy


@dataclass(frozen=True)
class Episode:
    """The outcome of one rollout.

    Attributes:
        init_state: Index of the initial state.
        success: Whether the goal was reached.
        length: Number of control steps of the policy, without the settling steps.
        at_start: Whether each atom of the goal held before the policy acted; empty if the environment does not
            report it.
        ever: Whether each atom held at any time from then on.
        at_end: Whether each atom held at the end.
        actions: Digest of the actions, (length, 7) float64: two episodes agree to the bit where it is the same.
        attempts: Number of draws of each perturbation that were not valid; empty without perturbations.
        simulation_error: Why the simulation failed and ended the episode, which is neither a success nor a failure;
            empty otherwise.
        failure: Why the goal was not reached; None where it was, or where the environment does not show its state.
        began: Number of control steps of the environment before each event began, -1 where it never did.
        costs: What it cost; None where the environment does not show its state.
        solved: Whether the expert solves what is left after each event, 1 or 0, -1 where it never began; empty where
            that was not tried.
        timing: Requests to the policy, answers that were used, and steps waited for one; empty without a clock.
    """

    init_state: int
    success: bool
    length: int
    at_start: tuple[bool, ...] = ()
    ever: tuple[bool, ...] = ()
    at_end: tuple[bool, ...] = ()
    actions: str = ""
    attempts: tuple[int, ...] = ()
    simulation_error: str = ""
    failure: Failure | None = None
    began: tuple[int, ...] = ()
    costs: Costs | None = None
    solved: tuple[int, ...] = ()
    timing: tuple[int, ...] = ()


@dataclass(frozen=True)
class Rollouts:
    """Outcomes of all simulations, in order, and recorded frames of some of them.

    Attributes:
        episodes: Outcome of each simulation.
        seconds: Wall time, [s].
        atoms: Atoms of the goal, in the order of the episodes' flags.
        recordings: Frames of each recorded simulation, (H, W, 3) uint8, upright.
        random: Whether the policy drew random numbers.
        limits_reached: How often a simulation reached a limit of the solver without an error, by its name (Warp).
    """

    episodes: tuple[Episode, ...]
    seconds: float
    atoms: tuple[str, ...] = ()
    recordings: tuple[tuple[np.ndarray, ...], ...] = field(default=(), repr=False)
    random: bool = False
    limits_reached: tuple[tuple[str, int], ...] = ()

    @property
    def frames(self) -> tuple[np.ndarray, ...]:
        """Frames of the first recorded simulation."""
        return self.recordings[0] if self.recordings else ()

    @property
    def counted(self) -> tuple[Episode, ...]:
        """Episodes that no error of the simulation has ended."""
        return tuple(e for e in self.episodes if not e.simulation_error)

    @property
    def failed(self) -> dict[int, str]:
        """Error of the simulation that has ended an episode, by the episode's index, as `SimulationError` takes it."""
        return {
            i: f"{e.simulation_error} (initial state {e.init_state})"
            for i, e in enumerate(self.episodes)
            if e.simulation_error
        }

    @property
    def rate(self) -> float:
        """Share of successes in the episodes that count.

        Raises:
            SimulationError: There are none: all simulations have failed.
        """
        if not self.counted:
            raise SimulationError(self.failed)
        return sum(e.success for e in self.counted) / len(self.counted)

    def columns(self) -> dict[str, Any]:
        """Return the fields of `lifelong.results.records.Episodes`."""
        return {
            "init_states": tuple(e.init_state for e in self.counted),
            "successes": tuple(e.success for e in self.counted),
            "lengths": tuple(e.length for e in self.counted),
            "atoms": self.atoms,
            "atoms_ever": tuple(e.ever for e in self.counted),
            "atoms_at_end": tuple(e.at_end for e in self.counted),
            "simulation_errors": tuple(
                (e.init_state, e.simulation_error) for e in self.episodes if e.simulation_error
            ),
            "limits_reached": self.limits_reached,
            "failures": tuple(e.failure for e in self.counted),
            "costs": tuple(e.costs for e in self.counted),
        }


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
    progress: bool | None = False,
) -> Rollouts:
    """Run episodes of a policy from the given initial states, all at once; see `run_episodes`.

    Args:
        policy: Policy, put in evaluation mode; its mode is restored afterwards.
        env: Environment with one simulation for each initial state.
        init_states: Indices of stored initial states, one per simulation.
        language: (L,) embedding of the instruction.
        horizon: Maximum number of control steps of the policy per episode.
        settle_steps: Number of steps before the policy acts.
        seed: Integers from which stochastic policies get a generator per episode.
        device: Device on which the policy acts.
        precision: Precision of the policy, see `lifelong.training.settings.FitSettings`.
        record_every: Number of control steps between two recorded frames of the first simulation; 0 records none.
        label: Text before the progress bar.
        progress: As for `libero_env.progress.progress_bar`.

    Raises:
        ConfigError: The numbers of simulations and of initial states differ.
    """
    import torch

    from lifelong.policies.base import in_mode

    draws = [generator(*seed, state) for state in init_states]
    before = _states(draws)
    with in_mode(policy, training=False):
        done = run_episodes(
            PolicyActor(policy, language, torch.device(device), precision, draws),
            env,
            init_states,
            horizon=horizon,
            settle_steps=settle_steps,
            record_every=record_every,
            label=label,
            progress=progress,
        )
    return replace(done, random=not before.equal(_states(draws)))


def run_episodes(
    actor: Actor,
    env: VectorEnv,
    init_states: Sequence[int],
    *,
    horizon: int,
    seeds: Sequence[int] | None = None,
    settle_steps: int = 5,
    settle_action: Sequence[float] | None = None,
    record_every: int = 0,
    recorded: Sequence[int] = (0,),
    label: str = "",
    progress: bool | None = False,
    on_step: Callable[[int, int], None] = lambda steps, most: None,
) -> Rollouts:
    """Run episodes of an actor from the given initial states, all at once.

    Each step is one call of the actor on all simulations. Finished simulations keep their row, so that the results of
    the others do not depend on when they finished, but they are neither stepped nor rendered. Images that nobody sees
    are not rendered: those of settling, and those between the observations of an actor that executes chunks. A
    simulation that fails ends its own episode only, see `Episode.simulation_error`.

    Args:
        actor: Actor that answers observations with actions.
        env: Environment with one simulation for each initial state.
        init_states: Indices of stored initial states, one per simulation.
        horizon: Maximum number of control steps of the actor per episode.
        seeds: Seeds by which initial states are sampled in place of the stored ones, which then are numbers only.
        settle_steps: Number of steps before the actor acts, so that objects come to rest (LIBERO: 5).
        settle_action: Action of these steps; zeros by default.
        record_every: Number of control steps between two recorded frames; 0 records none.
        label: Text before the progress bar.
        progress: As for `libero_env.progress.progress_bar`.
        on_step: Function called after each step with the number of control steps of all episodes, and with the largest
            number that it can become.

    Raises:
        ConfigError: The numbers of simulations and of initial states differ.
    """
    if env.num_envs != len(init_states):
        raise ConfigError(
            f"{len(init_states)} initial states, but the environment has {env.num_envs} simulations"
        )
    started, limits = time.perf_counter(), _limits_reached(env)
    actor.reset(env.num_envs)
    _draw(env, not settle_steps)
    stored = {"init_state": np.asarray(init_states)} if seeds is None else {}
    obs, info = env.reset(seed=seeds, options=stored)
    tracker = EpisodeTracker(env, info)
    settling = np.zeros(actor.action_dim) if settle_action is None else np.asarray(settle_action, float)
    for left in reversed(range(settle_steps)):
        _draw(env, not left)
        obs = tracker.step(np.tile(settling, (env.num_envs, 1)))
    tracker.start()
    lengths = np.zeros(env.num_envs, int)
    digests = [hashlib.sha256() for _ in init_states]
    recordings: list[list[np.ndarray]] = [[] for _ in (recorded if record_every else ())]
    bar = progress_bar(total=env.num_envs * horizon, desc=label, unit="step", leave=False, progress=progress)
    for step in range(horizon):
        for frames, i in zip(recordings, recorded, strict=False):
            if step % record_every == 0 and not tracker.over[i]:
                frames.append(_frame(obs, actor.views, i))
        if tracker.over.all():
            break
        lengths += ~tracker.over
        _tell(actor, tracker, env)
        actions = actor.act(obs)
        for i in np.flatnonzero(~tracker.over).tolist():
            digests[i].update(np.asarray(actions[i], "<f8").tobytes())
        filmed = bool(recordings) and (step + 1) % record_every == 0
        _draw(env, filmed or getattr(actor, "sees_next", True))
        obs = tracker.step(actions)
        steps, running = int(lengths.sum()), int((~tracker.over).sum())
        bar.least_total, bar.total = steps, steps + running * (horizon - step - 1)
        bar.set_postfix(ended=env.num_envs - running, refresh=False)
        bar.update(steps - bar.n)
        on_step(steps, bar.total)
    bar.close()
    _draw(env, True)
    _tell(actor, tracker, env)
    timing = getattr(actor, "timing", None) or [()] * env.num_envs
    return Rollouts(
        tuple(
            tracker.episode(i, int(start), int(lengths[i]), digests[i].hexdigest()[:16], timing[i])
            for i, start in enumerate(init_states)
        ),
        time.perf_counter() - started,
        tracker.atoms,
        tuple(map(tuple, recordings)),
        limits_reached=tuple(sorted((_limits_reached(env) - limits).items())),
    )


def save_animation(frames: Sequence[np.ndarray], path: Path, *, seconds_per_frame: float) -> None:
    """Write frames, each (H, W, 3) uint8, as an animated WebP that repeats forever.

    Args:
        frames: Frames in order.
        path: File to write; its folder is created.
        seconds_per_frame: Duration of each frame, [s].
    """
    first, *rest = [Image.fromarray(frame) for frame in frames]
    duration = round(1000 * seconds_per_frame)
    with atomic_path(path) as part:
        first.save(part, "WEBP", save_all=True, append_images=rest, duration=duration, loop=0, quality=70)


class EpisodeTracker:
    """Steps an environment and tracks which episodes are over, their success, and which atoms of the goal held.

    Attributes:
        atoms: Atoms of the goal; empty if the environment does not report them.
        over: (B,) whether each episode is over.
        success: (B,) whether each episode has succeeded.
        errors: Why simulations have failed, by index.
        attempts: (B, perturbations) number of draws that were not valid.
        began: (B, events) number of control steps before each event, -1 where it has not begun.
        moved: (B,) whether an event has changed what is to be done, and the actor is not told yet.
    """

    def __init__(self, env: VectorEnv, info: Mapping[str, Any]):
        self._env = env
        self.atoms: tuple[str, ...] = tuple(getattr(env, "atoms", ()))
        self.over, self.success = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
        self.errors: dict[int, str] = {}
        none = np.zeros((env.num_envs, 0), int)
        self.attempts, self.began = info.get("attempts", none), info.get("began", none)
        self._now = self._progress(info)
        self._start = self._ever = self._now
        self.moved = np.zeros(env.num_envs, bool)
        self._watch: EpisodeWatch | None = getattr(env, "watch", None)

    def start(self) -> None:
        """Take the present state as that before the actor acts."""
        self._start = self._ever = self._now
        if self._watch is not None:
            for i in range(self._env.num_envs):
                self._watch.begin(i)

    def step(self, actions: np.ndarray) -> Obs:
        """Step all simulations with (B, A) actions and return their observations."""
        obs, _, terminated, truncated, info = self._env.step(actions)
        self.success = self.success | (np.asarray(info["success"], bool) & ~self.over)
        self.attempts, self.began = info.get("attempts", self.attempts), info.get("began", self.began)
        self.errors |= {i: why for i, why in info.get("errors", {}).items() if not self.over[i]}
        self._now = np.where(self.over[:, None], self._now, self._progress(info))
        self._ever = self._ever | self._now
        self.over = self.over | terminated | truncated
        self.moved = (self.moved | info.get("moved", False)) & ~self.over
        return obs

    def failure(self, i: int) -> Failure | None:
        """Return why an episode that is over, or has run out of time, failed; None where it has not, or for unknown."""
        if self._watch is None or self.success[i] or i in self.errors:
            return None
        lacking = self._env.missing(i)  # type: ignore[attr-defined]  # of those that are watched
        return self._watch.failure(i, self._ever[i].tolist(), lacking)

    def costs(self, i: int) -> Costs | None:
        """Return what an episode has cost so far; None where the environment does not show its state."""
        return None if self._watch is None else self._watch.costs[i]

    def episode(self, i: int, start: int, length: int, actions: str, timing: tuple[int, ...]) -> Episode:
        """Return the outcome of a simulation; for the arguments see `Episode`."""
        return Episode(
            start,
            bool(self.success[i]),
            length,
            at_start=tuple(self._start[i].tolist()),
            ever=tuple(self._ever[i].tolist()),
            at_end=tuple(self._now[i].tolist()),
            actions=actions,
            attempts=tuple(map(int, self.attempts[i])),
            simulation_error=self.errors.get(i, ""),
            failure=self.failure(i),
            began=tuple(map(int, self.began[i])),
            costs=self.costs(i),
            timing=timing,
        )

    def _progress(self, info: Mapping[str, Any]) -> np.ndarray:
        """Return whether each atom holds, (B, atoms) bool."""
        shape = (self._env.num_envs, len(self.atoms))
        return np.asarray(info["progress"], bool).reshape(shape) if self.atoms else np.zeros(shape, bool)


def _limits_reached(env: VectorEnv) -> Counter[str]:
    return Counter(getattr(getattr(env, "simulations", None), "limits_reached", {}))


def _draw(env: VectorEnv, wanted: bool) -> None:
    """Let an environment that can leave out images render them, or not."""
    if hasattr(env, "render_images"):
        env.render_images = wanted


def _tell(actor: Actor, tracker: EpisodeTracker, env: VectorEnv) -> None:
    """Tell an actor that wants to know which episodes are over, and what has become of the others.

    Raises:
        ConfigError: An event has changed a goal, and the actor cannot be told.
    """
    if isinstance(actor, TakesNote):
        actor.note(tracker.over, tracker.success)
    for i in map(int, np.flatnonzero(tracker.moved)):
        if isinstance(actor, Hears):
            actor.hear(i, env.task_of(i))  # type: ignore[attr-defined]  # events are of those that have it
        elif env.task_of(i) is not env.task:  # type: ignore[attr-defined]
            raise ConfigError(
                "an event has changed the goal, and this policy cannot be told another instruction during an episode: "
                "runs and the expert can; leave --event goal=... out"
            )
        tracker.moved[i] = False


def _states(draws: Sequence[torch.Generator]) -> Tensor:
    """Return the states of generators and of the global one, (n, bytes) uint8."""
    import torch

    return torch.stack([*(draw.get_state() for draw in draws), torch.get_rng_state()])


def _frame(obs: Obs, views: Sequence[str], i: int) -> np.ndarray:
    """Return the images of all cameras of a simulation, side by side."""
    return np.concatenate([np.array(obs[view][i]) for view in views], axis=1)
