"""Environments in worker processes, as one `gymnasium.vector.VectorEnv`: for different tasks side by side.

Workers are spawned, so that no OpenGL context and no lock is inherited; each makes its environment and its context
itself. A worker that dies, or does not answer in time, is replaced.
"""

import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from pydantic import Field

from libero_env.envs.batch import LiberoVectorEnv
from libero_env.envs.checks import ResetRequest, checked_actions, checked_index, checked_indices
from libero_env.envs.config import EnvConfig, show_options
from libero_env.envs.env import LiberoEnv
from libero_env.envs.worker import Failure, Worker, shut_down, wait_for
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.text import shown
from libero_env.validation import validate

EnvSpec = Mapping[str, Any] | Callable[[], gymnasium.Env]
Seconds = Annotated[float, Field(gt=0, le=1e6)]
_PERTURBED = ("attempts", "began", "moved")  # what perturbed environments tell in their infos
Outcome = tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class WorkerError(LiberoError):
    """Workers died, hung or raised; the message states which, on what task, why, and what to do.

    Attributes:
        failed: Reason of failure by index of the environment. These environments do not move until they are reset.
        outcome: Result that the call would have returned, None if there is none; rows of `failed` are zero, and
            truncated in a step.
    """

    def __init__(self, failed: Mapping[int, str], tasks: Sequence[str], outcome: Any = None):
        lines = [f"worker {i} ({tasks[i]}): {reason.rstrip()}" for i, reason in sorted(failed.items())]
        if outcome is None:
            remedy = "Nothing was started. Fix the arguments above; if the machine was only slow, raise start_timeout="
        else:
            remedy = (
                f"The others work. Reset these, with True at {sorted(failed)} in options={{'reset_mask': ...}}, to "
                "continue; if they were only slow, raise timeout="
            )
        super().__init__("\n".join([*lines, remedy]))
        self.failed, self.outcome = dict(failed), outcome


class SubprocEnv(LiberoVectorEnv):
    """Environments in worker processes, one in each; the same seeds give the same results as `LiberoEnv`.

    There is no autoreset: an environment whose episode is over does not move, and returns reward 0 until it is reset.
    Entries of observations whose shapes differ between environments, such as poses of their objects, are in
    `info["own"]`, one dictionary for each environment; `observation_space` has the others. `info["progress"]` and, with
    perturbations, `attempts`, `began` and `moved` are lists of what each `LiberoEnv` tells.

    Args:
        specs: Arguments of the `LiberoEnv` of each environment, `{"task": "libero_object/0", ...}`; or a function that
            makes an environment whose observations are a dictionary of arrays.
        timeout: Largest time of a reset, step or call, s.
        start_timeout: Largest time that workers may take to start and to build their scenes, s.
        gl_devices: Indices of the GPUs to render on, assigned in turn (`MUJOCO_EGL_DEVICE_ID`); by default the driver
            chooses.
        config: Configuration of all environments of `specs` that are not functions.
        **options: Fields of `EnvConfig` of these environments; arguments in `specs` take precedence.

    Attributes:
        tasks: Name of the task of each environment.

    Raises:
        WorkerError: A worker could not make its environment.
        UnknownNameError: An option does not exist.
        InvalidInputError: There are no environments, or a value is of another kind or outside of its range.
        LiberoError: Their action spaces differ.
        ClosedEnvironmentError: By every method, after `close`.

    Example:
        >>> specs = [{"task": "libero_object/0"}, {"task": "libero_goal/3"}]
        >>> envs = SubprocEnv(specs, cameras=("agentview",), camera_size=(64, 64))
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["agentview_rgb"].shape
        (2, 64, 64, 3)
        >>> observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        >>> infos["progress"][0]
        {'(In alphabet_soup_1 basket_1_contain_region)': False}
        >>> envs.close()
    """

    @show_options
    def __init__(
        self,
        specs: Sequence[EnvSpec],
        *,
        timeout: float = 60.0,
        start_timeout: float = 300.0,
        gl_devices: Sequence[int] = (),
        config: EnvConfig | None = None,
        **options: Any,
    ):
        self.timeout = validate(Seconds, timeout, prefix=("timeout",))
        self.start_timeout = validate(Seconds, start_timeout, prefix=("start_timeout",))
        devices = validate(list[Annotated[int, Field(ge=0)]], list(gl_devices), prefix=("gl_devices",))
        if not isinstance(specs, Sequence) or isinstance(specs, str) or not specs:
            raise InvalidInputError("SubprocEnv needs a list of at least one environment")
        if odd := [spec for spec in specs if not (callable(spec) or isinstance(spec, Mapping))]:
            raise InvalidInputError(
                f"{shown(odd[0])} is not an environment; expected a dictionary or a function"
            )
        if (config is not None or options) and all(map(callable, specs)):
            raise InvalidInputError(
                f"{', '.join([*['config'] * (config is not None), *options])}: for environments that are dictionaries; "
                "these are functions, which configure theirs themselves"
            )
        if options and any(isinstance(spec, Mapping) and "config" in spec for spec in specs):
            raise InvalidInputError(
                f"{', '.join(options)}: a dictionary has a config of its own, which would replace them; name them in it"
            )
        common = {"config": EnvConfig.from_options(config, options)}
        self.metadata = {**self.metadata, "render_fps": common["config"].control_freq}
        factories = [spec if callable(spec) else _factory({**common, **spec}) for spec in specs]
        self.num_envs, self.render_mode = len(specs), None
        self.tasks = tuple(_task_name(spec) for spec in specs)
        self._workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, shut_down, self._workers)
        for i, factory in enumerate(factories):
            variables = {"MUJOCO_EGL_DEVICE_ID": str(devices[i % len(devices)])} if devices else {}
            self._workers.append(Worker(self.tasks[i], factory, variables))
        try:
            self._open()
        except LiberoError:
            self.close()
            raise
        self._running = np.zeros(self.num_envs, bool)
        self._success = np.zeros(self.num_envs, bool)
        self._infos: list[Mapping[str, Any]] = [{} for _ in specs]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One seed for each environment, or one number from which they count up.
            options: `init_state`: index of one stored state, or of one for each environment, (num_envs,).
                `reset_mask`: which environments to reset, (num_envs,) bool; by default all. Others are passed to the
                environments.

        Raises:
            WorkerError: Some workers failed; the others have been reset.
            InvalidInputError: Seeds, mask or initial states have the wrong length or are of another kind; nothing has
                changed.
        """
        self.require_open()
        request = ResetRequest.from_arguments(self.num_envs, seed, options, valid=None)
        others = {
            key: value for key, value in (options or {}).items() if key not in ("reset_mask", "init_state")
        }
        ids = [int(i) for i in request.ids]
        _, failed = self._collect([i for i in ids if not self._workers[i].opened], self.start_timeout)
        ids = [i for i in ids if i not in failed]
        for i in ids:
            start = {} if request.init_states is None else {"init_state": int(request.init_states[i])}
            how = {"seed": request.seeds[i], "options": {**others, **start}}
            self._workers[i].send("call", "reset", (), how)
        answers, more = self._collect_observed(ids)
        for i, (observation, info) in answers.items():
            self._note(i, observation, info)
            self._running[i], self._success[i] = True, bool(info.get("success", False))
        return self._result((self._observe(), self._info()), failed | more)

    def step(self, actions: np.ndarray) -> Outcome:
        """Apply actions in every environment that is in an episode.

        Args:
            actions: Action of each environment, (num_envs, 7) by default.

        Raises:
            ActionError: The shape is wrong, or a value is not finite; no state has changed.
            WorkerError: Some workers failed; the others have stepped, see `WorkerError.outcome`.
        """
        self.require_open()
        actions = checked_actions(actions, self.action_space.shape)
        ids = [int(i) for i in np.flatnonzero(self._running)]
        for i in ids:
            self._workers[i].send("call", "step", (actions[i],), {})
        answers, failed = self._collect_observed(ids)
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        for i, (observation, reward, end, cut, info) in answers.items():
            self._note(i, observation, info)
            rewards[i], terminated[i], truncated[i] = reward, end, cut
            self._success[i] |= bool(info.get("success", end))
            self._running[i] = not (end or cut)
        truncated[list(failed)] = True
        return self._result((self._observe(), rewards, terminated, truncated, self._info()), failed)

    def call(self, name: str, *args: Any, indices: Sequence[int] | None = None, **kwargs: Any) -> list[Any]:
        """Return an attribute of each environment, or the result of calling it.

        Args:
            name: Name of the attribute.
            *args: Arguments of the call.
            indices: Indices of the environments, in this order; by default all.
            **kwargs: Keyword arguments of the call.

        Raises:
            WorkerError: Some workers failed; `outcome` has None for them.
        """
        self.require_open()
        indices = [int(i) for i in checked_indices(indices, self.num_envs)]
        closed = [i for i in indices if not self._workers[i].opened]
        _, failed = self._collect(closed, self.start_timeout)
        called = [i for i in indices if i not in failed]
        for i in called:
            self._workers[i].send("look", name, args, kwargs)
        answers, more = self._collect(called, self.timeout, keep_running=True)
        return self._result([answers.get(i) for i in indices], failed | more)

    def get_state(self, i: int) -> np.ndarray:
        """Return the state of environment i, as `LiberoEnv.get_state`."""
        return self.call("get_state", indices=[i])[0]

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state of `get_state` in environment i."""
        i = checked_index(i, self.num_envs)
        self.call("set_state", state, indices=[i])
        self._running[i], self._success[i] = True, False

    def close_extras(self, **kwargs: Any) -> None:
        """End the workers."""
        self._finalizer()

    def _open(self) -> None:
        """Wait for all environments, and determine the common spaces."""
        answers, failures = wait_for(dict(enumerate(self._workers)), self.start_timeout)
        if failures:
            raise WorkerError({i: f.reason for i, f in failures.items()}, self.tasks)
        observed = [answers[i][0] for i in range(self.num_envs)]
        for task, space in zip(self.tasks, observed, strict=True):
            is_dict = isinstance(space, spaces.Dict)
            if not is_dict or any(not isinstance(box, spaces.Box) for box in space.values()):
                raise LiberoError(f"{task}: observations must be a dictionary of arrays, not {space}")
        first = answers[0][1]
        if different := [self.tasks[i] for i in range(self.num_envs) if answers[i][1] != first]:
            raise LiberoError(
                f"the action spaces of {', '.join(different)} differ from {first} of {self.tasks[0]}"
            )
        for worker in self._workers:
            worker.opened = True
        self._rows = [{k: np.zeros(box.shape, box.dtype) for k, box in o.items()} for o in observed]
        self._common = [k for k, box in observed[0].items() if all(o.spaces.get(k) == box for o in observed)]
        self.single_observation_space = spaces.Dict({key: observed[0][key] for key in self._common})
        self.single_action_space = first
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(first, self.num_envs)

    def _collect(
        self, ids: Sequence[int], timeout: float, keep_running: bool = False
    ) -> tuple[dict[int, Any], dict[int, str]]:
        """Return the answers, and the reasons of workers that gave none; lost processes are replaced."""
        workers = {i: self._workers[i] for i in ids}
        try:
            answers, failures = wait_for(workers, timeout)
        except KeyboardInterrupt:
            for worker in workers.values():  # or their answers would be taken for those to the next command
                worker.process.kill()
            raise
        for i in answers:
            self._workers[i].opened = True
        for i, failure in failures.items():
            self._handle_failure(i, failure, keep_running)
        return answers, {i: failure.reason for i, failure in failures.items()}

    def _collect_observed(self, ids: Sequence[int]) -> tuple[dict[int, Any], dict[int, str]]:
        """Return answers that begin with an observation, as `_collect`; one that lacks an entry is a failure."""
        answers, failed = self._collect(ids, self.timeout)
        for i in list(answers):
            observation = answers[i][0]
            if lacking := [key for key in self._rows[i] if key not in observation]:
                failed[i] = (
                    f"its observation has no {lacking[0]}, which its observation_space has; it has "
                    f"{', '.join(observation) or 'nothing'}"
                )
                del answers[i]
                self._handle_failure(i, Failure(failed[i], lost=False), keep_running=False)
        return answers, failed

    def _handle_failure(self, i: int, failure: Failure, keep_running: bool) -> None:
        """Replace a worker whose process is lost; end its episode and clear its observation."""
        worker = self._workers[i]
        if failure.lost or not worker.opened:
            worker.kill()
            worker.start()
        if failure.lost or not keep_running:
            self._running[i] = False
            for row in self._rows[i].values():
                row[...] = 0

    def _note(self, i: int, observation: Mapping[str, np.ndarray], info: Mapping[str, Any]) -> None:
        """Keep the observation of an environment, and what it tells."""
        for key, row in self._rows[i].items():
            row[...] = observation[key]
        self._infos[i] = info

    def _observe(self) -> dict[str, np.ndarray]:
        return {key: np.stack([rows[key] for rows in self._rows]) for key in self._common}

    def _info(self) -> dict[str, Any]:
        info: dict[str, Any] = {
            "success": self._success.copy(),
            "progress": [dict(one.get("progress", {})) for one in self._infos],
        }
        told = [key for key in _PERTURBED if any(key in one for one in self._infos)]
        info |= {key: [one.get(key) for one in self._infos] for key in told}
        own = [
            {key: row.copy() for key, row in rows.items() if key not in self._common} for rows in self._rows
        ]
        return {**info, "own": own} if any(own) else info

    def _result(self, outcome: Any, failed: Mapping[int, str]) -> Any:
        """Return the outcome of a call, or raise an error that has it if some workers failed."""
        if failed:
            raise WorkerError(failed, self.tasks, outcome)
        return outcome


def _factory(arguments: Mapping[str, Any]) -> Callable[[], gymnasium.Env]:
    """Return a function that makes a `LiberoEnv` in a worker, after a check of the names of its arguments."""
    if "task" not in arguments:
        given = ", ".join(name for name in arguments if name != "config") or "none"
        raise LiberoError(f"each environment needs a 'task'; got the keys {given}")
    other = ("task", "config", "render_mode")
    EnvConfig.from_options(arguments["config"], {k: v for k, v in arguments.items() if k not in other})
    return partial(LiberoEnv, **arguments)


def _task_name(spec: EnvSpec) -> str:
    if callable(spec):
        return getattr(spec, "__name__", repr(spec))
    return getattr(spec["task"], "id", str(spec["task"]))
