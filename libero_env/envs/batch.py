"""Simulations of one task in one process, as a `gymnasium.vector.VectorEnv`.

`BatchEnv.reset` and `step` check what callers pass; `start` and `advance` run the hooks of `libero_env.envs.hooks`:
those of `goals`, `watching`, and `libero_env.perturbations`.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from pydantic import Field

from libero_env.envs.checks import (
    ResetRequest,
    check_range,
    checked_actions,
    checked_index,
    checked_indices,
    checked_numbers,
)
from libero_env.envs.config import EnvConfig, show_options
from libero_env.envs.goals import GoalHooks
from libero_env.envs.hooks import Entries, Hooks, overridden
from libero_env.envs.observing import Observing
from libero_env.envs.scenes import check_memory, open_scenes
from libero_env.envs.vector import LiberoVectorEnv
from libero_env.envs.watching import WatchHooks
from libero_env.errors import InvalidInputError, SimulationError
from libero_env.init_states.placement import sample_states
from libero_env.init_states.store import load_init_states
from libero_env.sim.engine import Goals, make_observer, make_simulations
from libero_env.sim.scene import InitialStates
from libero_env.sim.watch import EpisodeWatch
from libero_env.tasks import Task
from libero_env.tasks.expression import Expression
from libero_env.timing import PHYSICS_HZ
from libero_env.validation import validate

Count, Threads = Annotated[int, Field(ge=1)], Annotated[int, Field(ge=0, le=4096)]
Outcome = tuple[Entries, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class BatchEnv(LiberoVectorEnv):
    """Simulations of one task that are stepped together; the results of each are bit-identical to `LiberoEnv`.

    There is no autoreset: a simulation whose episode is over does not move, is not rendered, and returns reward 0
    until it is reset.

    Args:
        task: `Task`, or an argument of `get_task`: `libero_object/3`, `libero_object-3`, or a task's name.
        num_envs: Number of simulations.
        num_threads: Number of threads of the physics; 0 is one for each core. Results do not depend on it.
        config: Configuration of all simulations.
        **options: Fields of `EnvConfig`, such as `camera_size=(64, 64)`, which replace those of `config`.

    Attributes:
        task: Task of the simulations, as the perturbations of the configuration change it.
        scene: Compiled scene of the task.
        later: Task that an event changes it into; None without one.
        base_task: The task without perturbations, to which initial states belong.
        base_scene: Compiled scene of that task.
        perturbed: Samples and filters of the perturbations; None without any.
        simulations: Physics and controllers.
        views: State view of each simulation.
        observer: Observer of the simulations.
        goal: Which simulations have reached their goal.
        steps: Number of control steps of each episode, (num_envs,).
        errors: Why simulations have failed, by index.
        generators: Random generator of each simulation.
        render_images: Whether images are rendered in each step. If False, observations have the images that were
            rendered last (black before the first); `render_cameras` renders those of the current state. May be set.

    Raises:
        UnknownNameError: The task, a camera, an option or a value of an option does not exist.
        InvalidInputError: A value is of another kind or outside of its range, or the memory does not suffice.
        ClosedEnvironmentError: By every method, after `close`.

    Examples:
        >>> envs = BatchEnv("libero_object/3", num_envs=4, cameras=("agentview",), camera_size=(64, 64))
        >>> observations, infos = envs.reset(options={"init_state": [0, 1, 2, 3]})
        >>> observations["agentview_rgb"].shape
        (4, 64, 64, 3)
        >>> observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        >>> infos["success"].tolist()
        [False, False, False, False]
        >>> envs.close()
    """

    @show_options
    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        *,
        num_threads: int = 0,
        config: EnvConfig | None = None,
        **options: Any,
    ):
        self.config = config = EnvConfig.from_options(config, options)
        self.num_envs = num = validate(Count, num_envs, prefix=("num_envs",))
        threads = validate(Threads, num_threads, prefix=("num_threads",))
        self.render_mode, self.metadata = None, {**self.metadata, "render_fps": config.control_freq}
        scenes = open_scenes(task, config, num)
        self.task, self.scene, self.later = scenes.task, scenes.scene, scenes.later
        self.base_task, self.base_scene, self.perturbed = (
            scenes.base_task,
            scenes.base_scene,
            scenes.perturbed,
        )
        check_memory(self.scene, config, num)
        self.simulations = make_simulations(
            self.scene.model, num, threads, self.scene.fixture_bodies, config.backend
        )
        self.simulations.substeps = PHYSICS_HZ // config.control_freq
        self.simulations.set_controller(config.controller, config.control_delta, self.base_task.rest)
        self.observer = make_observer(
            self.scene,
            self.simulations,
            observations=config.observations,
            cameras=config.cameras,
            camera_size=config.camera_size,
        )
        self.views, controller = self.observer.views, self.simulations.controller_state.controller
        self.single_observation_space = self.observer.space()
        self.single_action_space = spaces.Box(
            controller.low.astype(np.float32), controller.high.astype(np.float32)
        )
        self.observation_space = batch_space(self.single_observation_space, num)
        self.action_space = batch_space(self.single_action_space, num)
        self.generators = [np.random.default_rng() for _ in range(num)]
        self.steps, self._running, self.errors = (
            np.zeros(num, np.int64),
            np.zeros(num, bool),
            dict[int, str](),
        )
        self.observing = Observing(self.observer, config)
        others = [] if self.later is None else [self.later.problem.goal]
        self.goal = GoalHooks([self.scene.problem.goal, *others], self.views, config)
        self._parts: list[Hooks] = []
        self.plug(*scenes.hooks, self.goal)

    def plug(self, *parts: Hooks) -> None:
        """Let parts take part in episodes, after those that do; none of them may be running."""
        self._parts.extend(parts)
        for part in parts:
            part.attach(self)
        self._hooks = overridden(self._parts)
        self.observing.arrives = self._hooks["observe"]
        self.observing.has_memory = any(part.has_memory for part in self._parts)

    @property
    def render_images(self) -> bool:
        """Whether images are rendered in each step; may be set."""
        return self.observing.render_images

    @render_images.setter
    def render_images(self, wanted: bool) -> None:
        self.observing.render_images = wanted

    @property
    def goals(self) -> Goals:
        """The goal of the task, and its atoms, in the simulations."""
        return self.goal.goals[0]

    @property
    def atoms(self) -> tuple[str, ...]:
        """Atoms of the goal, as `progress` has them; then those of the other that an event makes the goal."""
        return tuple(map(str, self.goals.atoms))

    @cached_property
    def watching(self) -> WatchHooks:
        """What watches episodes from when it is first asked for."""
        found = WatchHooks(self.views, self.goal)
        self.plug(found)
        return found

    @property
    def watch(self) -> EpisodeWatch:
        """Traces of the episodes, see `watching`."""
        return self.watching.watch

    @cached_property
    def init_states(self) -> InitialStates:
        """Stored initial states of `base_task`."""
        return load_init_states(self.base_task, self.base_scene)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Entries, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One seed for each simulation, or one number from which they count up.
            options: `init_state`: index of one stored state, or of one for each simulation, (num_envs,).
                `start`: instead of it, a state for each simulation, [time, qpos, qvel, poses of the fixtures], of the
                task without perturbations; where both are given, the index only names what perturbations sample.
                `outdated_controller`: whether the controller takes the arm to be in its rest pose at first, as that of
                the original, see `libero_env.sim.simulation.Simulations.outdate_controller`.
                `reset_mask`: which simulations to reset, (num_envs,) bool; by default all.

        Returns:
            Observations and infos, see `step`.

        Raises:
            UnknownNameError: An option does not exist; nothing has changed.
            InvalidInputError: An initial state does not exist, or seeds, mask or starts have the wrong length or are of
                another kind; nothing has changed.
            PlacementError: The objects do not fit; none of these simulations is in an episode.
        """
        self.require_open()
        return self.start(ResetRequest.from_arguments(self.num_envs, seed, options))

    def start(self, request: ResetRequest) -> tuple[Entries, dict[str, Any]]:
        """Start episodes as a request says whose arguments have been checked; see `reset`."""
        ids, states, names = request.ids, self._given_states(request), request.names
        if ids.size:
            self._running[ids] = False  # until it is done: an error or an interruption ends the episodes
            for i in map(int, ids):
                self.errors.pop(i, None)
                if (new_seed := request.seeds[i]) is not None:
                    self.generators[i] = np.random.Generator(np.random.PCG64(new_seed))
            if states is None:
                states = sample_states(self.base_scene, [self.generators[i] for i in ids])
            for before_reset in self._hooks["before_reset"]:
                states = before_reset(ids, states, names)
            self.place(ids, states)
            if request.outdated_controller:
                self.simulations.outdate_controller(ids)
            self.steps[ids] = 0
            for after_reset in self._hooks["after_reset"]:
                after_reset(ids)
            self._running[ids] = True
        return self.observing.with_images(self.observing.look(ids)), self._info()

    def step(self, actions: np.ndarray) -> Outcome:
        """Apply actions for a control step, by default 50 ms, in every simulation that is in an episode.

        Args:
            actions: Action of each simulation, (num_envs, 7) by default.

        Returns:
            Observations, rewards (num_envs,), terminations, truncations, and infos: `success` (num_envs,) bool and
            `progress` (num_envs, natoms) bool, whether each of the goal's `atoms` holds. Both keep the outcome of
            episodes that are over. With perturbations also `attempts` (num_envs, n): how many samples of each were not
            valid at the reset. With events `began`, (num_envs, events): control steps before each, -1 until then; and
            `moved` (num_envs,) bool: whether one has just changed what is to be done. Where a simulation has diverged,
            its episode is truncated, and `errors` has the reason by its index until it is reset.

        Raises:
            ActionError: The shape is wrong, or a value is not a finite number; no state has changed.
        """
        self.require_open()
        return self.advance(checked_actions(actions, self.action_space.shape))

    def advance(self, actions: np.ndarray) -> Outcome:
        """Step with actions that have been checked, (num_envs, action_dim) float64; see `step`."""
        running, ids = self._running.copy(), np.flatnonzero(self._running)
        self._running[:] = False  # until it is done: a step that is interrupted has moved some substeps
        self.goal.rewards[:] = 0.0
        if not ids.size:
            entries = self.observing.state()
        else:
            for before_step in self._hooks["before_step"]:
                actions = before_step(ids, actions)
            watch = self.observing.before_step()
            try:
                self.simulations.step(ids, actions, watch=watch)
            except SimulationError as error:
                self.errors |= error.failed
            entries = self.observing.after_step(ids)
            self.steps[ids] += 1
            for after_step in self._hooks["after_step"]:
                after_step(ids)
        failed = np.isin(np.arange(self.num_envs), list(self.errors))
        reached = running & self.goal.success
        truncated = running & ~reached & (failed | (self.steps >= self.config.horizon))
        self._running = running & ~(reached | truncated)
        seen = self.observing.with_images(entries)
        return seen, self.goal.rewards.copy(), reached, truncated, self._info()

    def get_state(self, i: int) -> np.ndarray:
        """Return all that the rest of the episode in simulation i depends on, see `LiberoEnv.get_state`."""
        self.require_open()
        i = checked_index(i, self.num_envs)
        own = self.simulations.get_state(i), self.steps[i : i + 1]
        return np.concatenate([*own, *(part.state(i) for part in self._parts)])

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state in simulation i; see `LiberoEnv.set_state`.

        Raises:
            InvalidInputError: There is no such simulation, or the state is not valid; nothing has changed.
        """
        self.require_open()
        i, (simulation, steps, parts) = checked_index(i, self.num_envs), self._checked_state(state)
        self._running[i] = False
        self.errors.pop(i, None)
        if steps is None:
            self.simulations.set_physics_state(i, simulation)
        else:
            self.simulations.set_state(i, simulation)
        self.steps[i] = steps or 0
        for part, values in zip(self._parts, parts, strict=True):
            part.restore(i, values)
        self._running[i] = True

    def observe(self, i: int) -> Entries:
        """Return the observation of simulation i in its present state: name -> (1, ...)."""
        self.require_open()
        seen = self.observing.with_images(self.observing.look([i])).items()
        return {name: rows[[i]] for name, rows in seen}

    def proprioception(self) -> Entries:
        """Return all observations except images: name -> (num_envs, length) float64."""
        return self.observing.state()

    def render_cameras(self, ids: Sequence[int] | None = None) -> Entries:
        """Render the observed images of the current states: name -> (n, H, W, ...).

        Args:
            ids: Indices of the simulations; by default all.
        """
        self.require_open()
        rows = checked_indices(ids, self.num_envs)
        self.observing.render(rows)
        return {key: images[rows] for key, images in self.observing.images.items()}

    def check_goal(self, i: int) -> tuple[bool, dict[str, bool]]:
        """Return whether the goal is reached in simulation i, and whether each of its atoms holds, by its text."""
        reached, held = self.goal.check(np.array([i]))
        return bool(reached[0]), dict(zip(self.atoms, map(bool, held[0]), strict=True))

    def missing(self, i: int) -> list[Expression]:
        """Return what the episode in simulation i lacks now, see `libero_env.sim.history.History.missing`."""
        return self.goal.of(i).missing(i)

    def task_of(self, i: int) -> Task:
        """Return the task of simulation i, whose goal an event may have changed."""
        return self.later if self.later is not None and self.goal.which[i] else self.task

    def place(self, ids: np.ndarray, states: InitialStates) -> None:
        """Start the simulations ids, (k,), from states, [time, qpos, qvel, fixtures], (k, size); no episode begins."""
        qpos, qvel, fixtures = self.scene.split_states(states)
        self.simulations.reset(ids, qpos, qvel, fixtures=fixtures)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations and the OpenGL context."""
        self.observer.close()
        self.simulations.close()

    def _given_states(self, request: ResetRequest) -> InitialStates | None:
        """Return the states of `base_task` that are asked for, (k, size); None for new placements."""
        if request.starts is not None:
            states, scene = request.starts[request.ids], self.base_scene
            if states.shape[1] != scene.state_size:
                raise InvalidInputError(
                    f"{self.task.id}: a start has {scene.state_size} numbers, [time, qpos, qvel] and the poses of "
                    f"{len(scene.fixtures)} fixtures; got {states.shape[1]}. Is it one of another task?"
                )
            check_range(states, self.task)
            return states
        if request.init_states is None:
            return None
        indices, stored = request.init_states[request.ids], self.init_states
        if ((indices < 0) | (indices >= len(stored))).any():
            raise InvalidInputError(
                f"init_state {indices.tolist()}: {self.task.id} has 0 to {len(stored) - 1}"
            )
        return stored[indices]

    def _checked_state(self, state: object) -> tuple[np.ndarray, int | None, list[np.ndarray | None]]:
        """Return the parts of a vector of `get_state`, or [time, qpos, qvel], as float64.

        Returns:
            State of the simulation, number of steps, and what belongs to each part of the environment; None for both
            in a state of the simulation alone.
        """
        model, own = self.scene.model, [part.state(0).size for part in self._parts]
        ends = np.cumsum([self.simulations.state_size, 1, *own])
        name = f"state of {self.task.id} (get_state, or [time, qpos, qvel])"
        array = checked_numbers(state, name, ((int(ends[-1]),), (1 + model.nq + model.nv,)))
        check_range(array, self.task)
        if array.size != ends[-1]:
            return array, None, [None] * len(own)
        simulation, steps, *parts = np.split(array, ends[:-1])
        whole = [values for part, values in zip(self._parts, parts, strict=True) if part.is_counted]
        counts = np.concatenate([steps, *whole])
        if not (counts[0] >= 0 and (counts >= -1).all() and (counts % 1 == 0).all()):
            raise InvalidInputError(
                "a state ends with its number of steps, those before each event, and what the goal remembers; got "
                f"{counts.tolist()}"
            )
        return simulation, int(steps[0]), list(parts)

    def _info(self) -> dict[str, Any]:
        info = {key: value for hook in self._hooks["info"] for key, value in hook().items()}
        return {**info, "errors": dict(self.errors)} if self.errors else info
