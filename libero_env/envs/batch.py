"""Simulations of one task in one process, as a `gymnasium.vector.VectorEnv`."""

from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, NoReturn, Self

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from pydantic import Field

from libero_env.envs.checks import (
    ClosedGymEnvironmentError,
    ResetRequest,
    checked_actions,
    checked_index,
    checked_indices,
    checked_numbers,
)
from libero_env.envs.config import AFTER, EnvConfig, show_options
from libero_env.envs.scenes import open_scenes
from libero_env.errors import InvalidInputError, PlacementError, SimulationError
from libero_env.init_states.placement import sample_states
from libero_env.init_states.store import load_init_states
from libero_env.memory import require_memory
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations.episodes import TRIES
from libero_env.perturbations.events import NEVER, PHASES, has_begun, require_moment
from libero_env.perturbations.kinds import start_name
from libero_env.sim.engine import Goals, make_observer, make_simulations
from libero_env.sim.observations import is_of_joints
from libero_env.sim.rewards import Reward
from libero_env.sim.scene import BUFFER_SIDE, InitialStates, ground
from libero_env.sim.simulation import Indices
from libero_env.sim.watch import EpisodeWatch
from libero_env.tasks import Task
from libero_env.tasks.problem import And, Atom, Expression, Or
from libero_env.timing import CONTROL_HZ, PHYSICS_HZ
from libero_env.validation import validate

Count = Annotated[int, Field(ge=1)]
Threads = Annotated[int, Field(ge=0, le=4096)]
Images = dict[str, np.ndarray]  # (num_envs, height, width, ...) by name


class LiberoVectorEnv(gymnasium.vector.VectorEnv):
    """A vector environment without autoreset, which `with` closes; after `close` every use is an error."""

    metadata = {"render_modes": [], "render_fps": CONTROL_HZ, "autoreset_mode": AutoresetMode.DISABLED}

    _running: np.ndarray

    @property
    def running(self) -> np.ndarray:
        """Whether each environment is in an episode, (num_envs,) bool."""
        return self._running.copy()

    def render(self) -> NoReturn:
        """Raise: `render_cameras` or `call` return images of vector environments."""
        self.require_open()
        raise InvalidInputError("a vector environment has no render(); its observations have the images")

    def require_open(self) -> None:
        """Raise a `ClosedEnvironmentError` after `close`."""
        if self.closed:
            raise ClosedGymEnvironmentError("this environment is closed; make another")

    def __enter__(self) -> Self:
        """Return the environments; they are closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        raise InvalidInputError(
            "an environment cannot be copied or pickled: it holds simulations, processes or an OpenGL context. Make "
            "another with the same task and config=, and pass it the state: set_state(get_state())"
        )


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
        config: Configuration of all simulations.
        task: Task of the simulations, as the perturbations of the configuration change it.
        scene: Compiled scene of the task.
        later: Task that an event changes it into; None without one.
        base_task: The task without perturbations, to which initial states belong.
        base_scene: Compiled scene of that task.
        perturbed: Samples and filters of the perturbations; None without any.
        simulations: Physics and controllers.
        views: State view of each simulation.
        observer: Observer of the simulations.
        goals: The goal and its atoms in the simulations.
        generators: Random generator of each simulation.
        event_states: States just after events have begun, by simulation and event, of the present episodes.
        render_images: Whether images are rendered in each step. If False, observations have the images that were
            rendered last (black before the first); `render_cameras` renders those of the current state.

    Raises:
        UnknownNameError: The task, a camera, an option or a value of an option does not exist.
        InvalidInputError: A value is of another kind or outside of its range, or the memory does not suffice.
        ClosedEnvironmentError: By every method, after `close`.

    Example:
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
        self.render_mode, self.render_images = None, True
        self.metadata = {**self.metadata, "render_fps": config.control_freq}
        self.reward = Reward(config.reward, config.reward_scale)
        scenes = open_scenes(task, config, num)
        self.task, self.scene, self.perturbed = scenes.task, scenes.scene, scenes.perturbed
        self.base_task, self.base_scene = scenes.base_task, scenes.base_scene
        self._check_memory()
        self.simulations = make_simulations(
            self.scene.model, num, threads, self.scene.fixture_bodies, config.backend
        )
        self.simulations.substeps = PHYSICS_HZ // config.control_freq
        self.simulations.set_controller(config.controller, config.control_delta, scenes.rest)
        self.observer = make_observer(
            self.scene,
            self.simulations,
            observations=config.observations,
            cameras=config.cameras,
            camera_size=config.camera_size,
        )
        self.views = self.observer.views
        goal = self.scene.problem.goal
        self.later, atoms = scenes.later, self.scene.goal_atoms
        later = None if scenes.later is None else scenes.later.problem.goal
        every = tuple(dict.fromkeys([*atoms, *(later.atoms() if later else ())]))
        self.goals = Goals(goal, every, self.views, config.semantics)
        self._later_goals = None if later is None else Goals(later, every, self.views, config.semantics)
        self._histories = [one.history for one in (self.goals, self._later_goals) if one is not None]
        if self.reward.kind == "staged":
            _require_stages(goal if later is None else later, changes=later is not None)
        controller = self.simulations.controller_state.controller
        self.single_observation_space = self.observer.space()
        self.single_action_space = spaces.Box(
            controller.low.astype(np.float32), controller.high.astype(np.float32)
        )
        self.observation_space = batch_space(self.single_observation_space, num)
        self.action_space = batch_space(self.single_action_space, num)
        self.generators = [np.random.default_rng() for _ in range(num)]
        self._images = self.observer.empty_images()
        self._steps, self._errors = np.zeros(num, np.int64), dict[int, str]()
        self._running, self._success = np.zeros(num, bool), np.zeros(num, bool)
        self._progress = np.zeros((num, len(self.atoms)), bool)
        triggers = [one.trigger for one in self.perturbed.perturbations] if self.perturbed is not None else []
        self._watched = any(triggers)
        self._has_phases = not {*triggers}.isdisjoint(PHASES)
        for trigger in triggers:
            require_moment(trigger, config.horizon)
        self._moved = np.zeros(num, bool)
        self.event_states: dict[tuple[int, int], np.ndarray] = {}

    @property
    def atoms(self) -> tuple[str, ...]:
        """Atoms of the goal, in the order of `progress` in infos, such as `(On plate_1 stove_1)`.

        Where an event changes the goal, those of the other one follow.
        """
        return tuple(map(str, self.goals.atoms))

    @cached_property
    def watch(self) -> EpisodeWatch:
        """Traces of the episodes; simulations are watched from when it is first asked for, or if there are events."""
        self._watched, found = True, EpisodeWatch(self.views, self.goals.atoms)
        for i in range(self.num_envs):
            found.goals[i] = self._goal_atoms(i)
        return found

    @cached_property
    def init_states(self) -> InitialStates:
        """Stored initial states of `base_task`."""
        return load_init_states(self.base_task, self.base_scene)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One seed for each simulation, or one number from which they count up.
            options: `init_state`: index of one stored state, or of one for each simulation, (num_envs,).
                `start`: instead of it, a state for each simulation, [time, qpos, qvel, poses of the fixtures], of the
                task without perturbations; where both are given, the index only names what perturbations sample.
                `outdated_controller`: whether the controller takes the arm to be in its rest pose at first, as that of
                the original, see `libero_env.sim.simulation.Simulations.outdate_controller`.
                `reset_mask`: which simulations to reset, (num_envs,) bool; by default all.

        Raises:
            UnknownNameError: An option does not exist; nothing has changed.
            InvalidInputError: An initial state does not exist, or seeds, mask or starts have the wrong length or are of
                another kind; nothing has changed.
            PlacementError: The objects do not fit; none of these simulations is in an episode.
        """
        self.require_open()
        request = ResetRequest.from_arguments(self.num_envs, seed, options)
        ids, states = request.ids, None
        if request.starts is not None:
            states = self._checked_starts(request.starts[ids])
        elif request.init_states is not None:
            states = self._stored_states(request.init_states[ids])
        if ids.size:
            self._running[ids] = False  # until it is done: an error or an interruption ends the episodes
            self._errors = {i: reason for i, reason in self._errors.items() if i not in ids}
            for i in ids:
                if (new_seed := request.seeds[i]) is not None:
                    self.generators[i] = np.random.Generator(np.random.PCG64(new_seed))
            if states is None:
                states = sample_states(self.base_scene, [self.generators[i] for i in ids])
            self._start(ids, states, None if request.init_states is None else request.init_states[ids])
            if request.outdated_controller:
                self.simulations.outdate_controller(ids)
            self._steps[ids], self._running[ids], self._moved[ids] = 0, True, False
            self._forget(ids)
            for i in map(int, ids) if self._watched else ():
                self.event_states = {key: state for key, state in self.event_states.items() if key[0] != i}
                self.watch.goals[i] = self._goal_atoms(i)
                self.watch.begin(i)
            self._success[ids] = self._check_goals(ids)[0]
        return self._with_images(self._observe(ids)), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
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

    def advance(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step with actions that have been checked, (num_envs, action_dim) float64; see `step`."""
        running, ids = self._running.copy(), np.flatnonzero(self._running)
        self._running[:] = False  # until it is done: a step that is interrupted has moved some substeps
        reached, rewards = np.zeros(self.num_envs, bool), np.zeros(self.num_envs)
        entries = {} if ids.size else self.proprioception()
        if ids.size:
            self._begin_events(ids)
            entries = self._step_and_observe(ids, actions)
            reached[ids], rewards[ids] = self._check_goals(ids)
            self._steps[ids] += 1
            for i in map(int, ids) if self._watched else ():
                self.watch.look(i)
        failed = np.isin(np.arange(self.num_envs), list(self._errors))
        reached, rewards = reached & ~failed, np.where(failed, 0.0, rewards)
        truncated = running & ~reached & (failed | (self._steps >= self.config.horizon))
        self._success[ids] = reached[ids]
        self._running = running & ~(reached | truncated)
        return self._with_images(entries), rewards, reached, truncated, self._info()

    def get_state(self, i: int) -> np.ndarray:
        """Return all that the rest of the episode in simulation i depends on, see `LiberoEnv.get_state`."""
        self.require_open()
        i = checked_index(i, self.num_envs)
        seen = [self.watch.memory(i)] if self._has_phases else []
        return np.concatenate([self.simulations.get_state(i), *self._kept(i), *seen])

    def _kept(self, i: int) -> list[np.ndarray]:
        """Return views of the whole numbers that belong to an episode beside its simulation."""
        perturbed = [] if self.perturbed is None else self.perturbed.kept(i)
        return [self._steps[i : i + 1], *perturbed, *(one.memory[i].ravel() for one in self._histories)]

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state in simulation i; see `LiberoEnv.set_state`.

        Raises:
            InvalidInputError: There is no such simulation, or the state is not valid; nothing has changed.
        """
        self.require_open()
        i, state = checked_index(i, self.num_envs), self._checked_state(state)
        self._running[i] = self._moved[i] = False
        self._errors.pop(i, None)
        self._forget(np.array([i]))
        kept, is_whole = self._kept(i), state.size > self.simulations.state_size
        sizes = np.cumsum([self.simulations.state_size, *(part.size for part in kept)])
        simulation, *values, seen = np.split(state, sizes)
        if is_whole:
            self.simulations.set_state(i, simulation)
            for part, value in zip(kept, values, strict=True):
                part[:] = value
        else:
            self.simulations.set_physics_state(i, state)
            self._steps[i] = 0
        if self.perturbed is not None:
            self.perturbed.resume(i, int(self._steps[i]), begins=not is_whole)
            self.observer.set_appearance(i, self.perturbed.appearance(i))
        if self._watched:
            self.watch.goals[i] = self._goal_atoms(i)
            self.watch.begin(i)
        if is_whole and self._has_phases:
            self.watch.recall(i, seen)
        if not is_whole and any(history.memory.size for history in self._histories):
            self._goals_reached(np.array([i]))  # the first moment
        self._running[i], self._success[i] = True, False

    def observe(self, i: int) -> dict[str, np.ndarray]:
        """Return the observation of simulation i in its present state, with a leading axis of one."""
        self.require_open()
        return {name: rows[[i]] for name, rows in self._with_images(self._observe([i])).items()}

    def proprioception(self) -> dict[str, np.ndarray]:
        """Return all observations except images: name -> (num_envs, length) float64."""
        entries = self.observer.state()
        return entries if self.perturbed is None else self.perturbed.see_state(entries)

    def render_cameras(self, ids: Sequence[int] | None = None) -> Images:
        """Render the observed images of the current states: name -> (n, H, W, ...).

        Args:
            ids: Indices of the simulations; by default all.
        """
        self.require_open()
        rows = checked_indices(ids, self.num_envs)
        self._render(rows, self._images)
        return {key: images[rows] for key, images in self._images.items()}

    def check_goal(self, i: int) -> tuple[bool, dict[str, bool]]:
        """Return whether the goal is reached in simulation i, and whether each of its atoms holds, by its text."""
        reached, held = self._goals_reached(np.array([i]))
        return bool(reached[0]), dict(zip(self.atoms, map(bool, held[0]), strict=True))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations and the OpenGL context."""
        self.observer.close()
        self.simulations.close()

    def _start(self, ids: np.ndarray, states: InitialStates, init_states: np.ndarray | None) -> None:
        """Start simulations from states of `base_task`, or from those that the perturbations make of them.

        Args:
            ids: Indices of the simulations, (k,).
            states: State of each.
            init_states: Indices of the states, (k,), which name the samples of perturbations; by default the states
                themselves do.

        Raises:
            PlacementError: Perturbations make no valid start of a state.
        """
        if self.perturbed is None:
            qpos, qvel, fixtures = self.scene.split_states(states)
            self.simulations.reset(ids, qpos, qvel, fixtures=fixtures)
            return
        names = map(start_name, states) if init_states is None else map(int, init_states)
        for i, name, state in zip(ids, names, states, strict=True):
            self._start_perturbed(int(i), name, state)

    def _start_perturbed(self, i: int, name: object, state: np.ndarray) -> None:
        """Start a simulation from what the perturbations make of a state; the goal does not hold there."""
        perturbed = self.perturbed
        assert perturbed is not None
        paired = perturbed.paired(i, name, state)
        for again in range(TRIES if perturbed.samples_starts else 1):
            start = perturbed.begin(i, name, paired, again)
            qpos, qvel, fixtures = self.scene.split_states(start[None])
            self.simulations.reset([i], qpos, qvel, fixtures=fixtures)
            self._forget(np.array([i]))
            if not perturbed.is_physical or not self.goals.check([i])[0][0]:
                break
        else:
            raise PlacementError(f"{self.base_task.id}, start {name}: the perturbed goal holds at the start")
        self.observer.set_appearance(i, perturbed.appearance(i))

    def _stored_states(self, indices: np.ndarray) -> InitialStates:
        """Return stored initial states by index, (k,)."""
        stored = self.init_states
        if ((indices < 0) | (indices >= len(stored))).any():
            raise InvalidInputError(
                f"init_state {indices.tolist()}: {self.task.id} has 0 to {len(stored) - 1}"
            )
        return stored[indices]

    def _checked_starts(self, states: np.ndarray) -> InitialStates:
        size, fixtures = self.base_scene.state_size, len(self.base_scene.fixtures)
        if states.shape[1] != size:
            raise InvalidInputError(
                f"{self.task.id}: a start has {size} numbers, [time, qpos, qvel] and the poses of {fixtures} fixtures; "
                f"got {states.shape[1]}. Is it one of another task?"
            )
        _check_range(states, self.task)
        return states

    def _checked_state(self, state: object) -> np.ndarray:
        """Return a vector of `get_state`, or [time, qpos, qvel], as float64."""
        model, first = self.scene.model, self.simulations.state_size
        last = first + sum(part.size for part in self._kept(0))
        size = last + (self.watch.memory(0).size if self._has_phases else 0)
        name = f"state of {self.task.id} (get_state, or [time, qpos, qvel])"
        array = checked_numbers(state, name, ((size,), (1 + model.nq + model.nv,)))
        _check_range(array, self.task)
        counts = array[first:last] if array.size == size else np.zeros(1)
        if not (counts[0] >= 0 and (counts >= NEVER).all() and (counts % 1 == 0).all()):
            raise InvalidInputError(
                "a state ends with its number of steps, those before each event, and what the goal remembers; got "
                f"{counts.tolist()}"
            )
        return array

    def _check_memory(self) -> None:
        """Raise if the simulations and their images do not fit into memory."""
        if self.num_envs == 1 and max(self.config.camera_size) <= BUFFER_SIDE:
            return
        height, width = self.config.camera_size
        images = 16 * height * width * len(self.config.cameras)
        model = self.scene.model
        state = 0 if self.config.backend.is_warp else model.narena + model.nbuffer // 8  # on the device
        require_memory(
            self.num_envs * (state + images),
            f"num_envs={self.num_envs}" if self.num_envs > 1 else f"camera_size={height}x{width}",
            "take fewer simulations or smaller images",
        )

    def _check_goals(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in each of the simulations, and its reward; note which atoms hold."""
        reached, held = self._goals_reached(ids)
        self._progress[ids] = held
        rewards = [
            self.reward(self.views[i], bool(won), self.goals.atoms, list(row))
            for i, won, row in zip(ids, reached, held, strict=True)
        ]
        return reached, np.array(rewards, np.float64)

    def _goals_reached(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether each simulation has reached its goal, (k,) bool, and which atoms hold, (k, natoms)."""
        reached, held = self.goals.check(ids)
        changed = np.array([self.task_of(i) is not self.task for i in ids], bool)
        if self._later_goals is not None and changed.any():
            reached[changed] = self._later_goals.check(ids[changed])[0]
        return reached, held

    def missing(self, i: int) -> list[Expression]:
        """Return what the episode in simulation i lacks now, see `libero_env.sim.history.History.missing`."""
        later = self._later_goals if self.task_of(i) is not self.task else None
        return (later or self.goals).missing(i)

    def _forget(self, ids: np.ndarray) -> None:
        """Begin the conditions over time of the goals anew."""
        for history in self._histories:
            history.begin(ids)

    def task_of(self, i: int) -> Task:
        """Return the task of simulation i, whose goal an event may have changed."""
        if self.later is not None and self.perturbed is not None and self.perturbed.has_new_goal(i):
            return self.later
        return self.task

    def _goal_atoms(self, i: int) -> tuple[Atom, ...]:
        return ground(self.task_of(i).problem.goal, self.scene).wanted()

    def _begin_events(self, ids: np.ndarray) -> None:
        """Let the events begin whose moment has come, before a control step."""
        perturbed, self._moved[:] = self.perturbed, False
        if perturbed is None or not perturbed.events:
            return
        for i in map(int, ids):
            for event, k in enumerate(perturbed.events):
                trigger, steps = perturbed.perturbations[k].trigger, int(perturbed.steps[i])
                waits = perturbed.began[i, event] == NEVER and perturbed.attempts[i, k] < TRIES
                if waits and has_begun(trigger, steps, self.config.horizon, self.watch, i):
                    self._begin_event(i, event)

    def _begin_event(self, i: int, event: int) -> None:
        """Let an event begin in simulation i; one that finds no valid place does not happen."""
        perturbed, simulations = self.perturbed, self.simulations
        assert perturbed is not None
        state, size = simulations.get_state(i), self.scene.state_size
        try:
            row = perturbed.begin_event(i, event, state[:size])
        except PlacementError:
            return
        if not np.array_equal(row, state[:size]):
            simulations.set_state(i, np.concatenate([row, state[size:]]))
            self.watch.measure_from_here(i)
        self.observer.set_appearance(i, perturbed.appearance(i))
        self.watch.goals[i] = self._goal_atoms(i)
        self._moved[i] |= perturbed.perturbations[perturbed.events[event]].definition.physical
        self.event_states[i, event] = self.get_state(i)

    def _step_and_observe(self, ids: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Advance simulations by one control period, and observe them when `config.observed` says."""
        if self.perturbed is not None:
            controller = self.simulations.controller_state.controller
            actions = self.perturbed.act(ids, np.clip(actions, controller.low, controller.high))
        is_after, (first, second) = self.config.observed == AFTER, self.simulations.watched
        seen = {} if is_after else self.proprioception()

        def watch(done: int, rows: np.ndarray) -> None:
            if done not in (first, second):
                return
            now = self.proprioception()
            if done == first:
                self._render_observed(rows)
            for name, values in now.items():
                if (done == second) == is_of_joints(name):
                    seen[name][rows] = values[rows]

        try:
            self.simulations.step(ids, actions, watch=None if is_after else watch)
        except SimulationError as error:
            self._errors |= error.failed
        return self._observe(ids) if is_after else seen

    def _observe(self, ids: Indices) -> dict[str, np.ndarray]:
        """Render the images of simulations, and return all observations except images."""
        self._render_observed(ids)
        return self.proprioception()

    def _render_observed(self, ids: Indices) -> None:
        """Render images where they are observed; unseen ones where a perturbation remembers them."""
        if self.render_images:
            self._render(ids, self._images)
        elif self.perturbed is not None and self.perturbed.has_memory:
            self._render(ids, self._unseen)

    @cached_property
    def _unseen(self) -> Images:
        return self.observer.empty_images()

    def _render(self, ids: Indices, images: Images) -> None:
        self.observer.render_cameras(ids, images)
        if self.perturbed is not None:
            self.perturbed.see_images(ids, images)

    def _with_images(self, entries: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return copies of the images, with the given observations of the state."""
        return {name: values.copy() for name, values in self._images.items()} | entries

    def _info(self) -> dict[str, Any]:
        info = {"success": self._success.copy(), "progress": self._progress.copy()}
        if self.perturbed is not None:
            info["attempts"] = self.perturbed.attempts.copy()
            info["began"] = self.perturbed.began.copy()
            info["moved"] = self._moved.copy()
        return {**info, "errors": dict(self._errors)} if self._errors else info


def _require_stages(goal: Expression, changes: bool) -> None:
    """Raise unless the atoms of a goal that hold are stages on the way to it."""
    staged = goal.fold(lambda node, parts: isinstance(node, Atom | And | Or) and all(parts))
    if changes or not staged:
        what = f"an event makes {goal} the goal" if changes else f"{goal} is more than atoms, And and Or"
        raise InvalidInputError(
            f"reward=staged counts the atoms of one goal that hold, but {what}; leave reward=sparse"
        )


def _check_range(states: np.ndarray, task: Task) -> None:
    """Raise unless MuJoCo takes the numbers: it resets a simulation with larger ones, without an error."""
    if not (np.abs(states) <= mujoco.mjMAXVAL).all():
        raise InvalidInputError(
            f"{task.id}: a state has a number beyond {mujoco.mjMAXVAL:g}, or not a number"
        )
