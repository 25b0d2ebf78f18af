"""Environments in processes of their own, as one `gymnasium.vector.VectorEnv`: for different tasks side by side.

Workers are spawned, so no OpenGL context and no lock is inherited; each makes its environment and its context itself.
Observations come back through shared memory. A worker that dies, or does not answer in time, is replaced.
"""

import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from libero_env.envs.checks import checked_actions
from libero_env.envs.worker import Failure, Worker, checked_space, open_libero, shut_down, wait_for
from libero_env.errors import LiberoError
from libero_env.timing import CONTROL_HZ

EnvSpec = Mapping[str, Any] | Callable[[], gymnasium.Env]
Outcome = tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class WorkerError(LiberoError):
    """Workers died, hung or raised; the message says which, on what task, why, and what to do.

    Attributes:
        failed: index of each environment that failed -> why. They stand still until they are reset.
        outcome: what the call would have returned, None if there is nothing; rows of `failed` are zero, and truncated
            in a step.
    """

    def __init__(self, failed: Mapping[int, str], tasks: Sequence[str], outcome: Any = None):
        lines = [f"worker {i} ({tasks[i]}): {why.rstrip()}" for i, why in sorted(failed.items())]
        if outcome is None:
            remedy = "Nothing was started. Mend the arguments above; if the machine was only slow, raise start_timeout="
        else:
            remedy = (
                f"The others work. Reset these, options={{'reset_mask': ...}} with {sorted(failed)}, to go on; "
                "if they were only slow, raise timeout="
            )
        super().__init__("\n".join([*lines, remedy]))
        self.failed, self.outcome = dict(failed), outcome


class SubprocEnv(gymnasium.vector.VectorEnv):
    """One worker process for each environment; the same seeds give the same results as `LiberoEnv`.

    There is no autoreset: an environment whose episode is over stands still and returns reward 0 until it is reset.
    Entries of observations that differ in shape between environments, such as poses of their objects, are in
    `info["own"]`, one dictionary for each environment; `observation_space` has the others.

    Args:
        specs: for each environment the arguments of its `LiberoEnv`, `{"task": "libero_object/0", ...}`; or a function
            that makes an environment whose observations are a dictionary of arrays.
        timeout: seconds that a reset, step or call may take.
        start_timeout: seconds that workers may take to start and build their scenes.
        gl_devices: GPUs to draw on, dealt out in turn (`MUJOCO_EGL_DEVICE_ID`); by default as the driver decides.

    Raises:
        WorkerError: a worker could not make its environment.
        LiberoError: no environments, or their action spaces differ.
    """

    metadata = {"render_modes": [], "render_fps": CONTROL_HZ, "autoreset_mode": AutoresetMode.DISABLED}

    def __init__(
        self,
        specs: Sequence[EnvSpec],
        *,
        timeout: float = 60.0,
        start_timeout: float = 300.0,
        gl_devices: Sequence[int] = (),
    ):
        if not specs:
            raise LiberoError("SubprocEnv needs at least one environment")
        self.num_envs, self.render_mode, self.timeout, self.start_timeout = (
            len(specs),
            None,
            timeout,
            start_timeout,
        )
        self.tasks = tuple(_task_name(spec) for spec in specs)
        self._workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, shut_down, self._workers)
        for i, spec in enumerate(specs):
            variables = {"MUJOCO_EGL_DEVICE_ID": str(gl_devices[i % len(gl_devices)])} if gl_devices else {}
            make = spec if callable(spec) else partial(open_libero, dict(spec))
            self._workers.append(Worker(self.tasks[i], make, variables))
        try:
            self._spaces = self._open()
        except LiberoError:
            self.close()
            raise
        self._running = np.zeros(self.num_envs, bool)
        self._success = np.zeros(self.num_envs, bool)
        self._progress: list[dict[str, bool]] = [{} for _ in specs]

    @property
    def running(self) -> np.ndarray:
        """Which environments are in an episode, (num_envs,) bool."""
        return self._running.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start episodes; arguments as `BatchEnv.reset`.

        Raises:
            WorkerError: some failed; the others have been reset.
            LiberoError: seeds or mask of the wrong length.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        if mask.shape != (self.num_envs,):
            raise LiberoError(f"reset_mask: expected ({self.num_envs},) booleans, got shape {mask.shape}")
        seeds = self._seeds(seed)
        wanted = None
        if "init_state" in options:
            wanted = np.broadcast_to(np.asarray(options.pop("init_state")), (self.num_envs,))
        ids = [int(i) for i in np.flatnonzero(mask)]
        failed = self._reopen([i for i in ids if not self._workers[i].opened])
        ids = [i for i in ids if i not in failed]
        for i in ids:
            own = options if wanted is None else {**options, "init_state": int(wanted[i])}
            self._workers[i].send("reset", seeds[i], own)
        answers, more = self._collect(ids, self.timeout)
        for i, info in answers.items():
            self._running[i], self._success[i] = True, bool(info.get("success", False))
            self._progress[i] = info.get("progress", {})
        return self._checked((self._observe(), self._info()), failed | more)

    def step(self, actions: np.ndarray) -> Outcome:
        """Act; environments that are not in an episode stand still.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
            WorkerError: some failed; the others have moved, see `WorkerError.outcome`.
        """
        actions = checked_actions(actions, self.num_envs, self._action_size)
        ids = [int(i) for i in np.flatnonzero(self._running)]
        for i in ids:
            self._workers[i].send("step", actions[i])
        answers, failed = self._collect(ids, self.timeout)
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        for i, (reward, end, cut, info) in answers.items():
            rewards[i], terminated[i], truncated[i] = reward, end, cut
            self._success[i] |= bool(info.get("success", end))
            self._progress[i] = info.get("progress", {})
            self._running[i] = not (end or cut)
        truncated[list(failed)] = True
        return self._checked((self._observe(), rewards, terminated, truncated, self._info()), failed)

    def call(self, name: str, *args: Any, indices: Sequence[int] | None = None, **kwargs: Any) -> list[Any]:
        """An attribute of each environment, or the result of calling it; for `indices` only, in their order.

        Raises:
            WorkerError: some failed; `outcome` has None for them.
        """
        indices = list(range(self.num_envs)) if indices is None else [int(i) for i in indices]
        failed = self._reopen([i for i in indices if not self._workers[i].opened])
        asked = [i for i in indices if i not in failed]
        for i in asked:
            self._workers[i].send("call", name, args, kwargs)
        answers, more = self._collect(asked, self.timeout, keep_running=True)
        return self._checked([answers.get(i) for i in indices], failed | more)

    def get_state(self, i: int) -> np.ndarray:
        """Environment i as `LiberoEnv.get_state` gives it."""
        return self.call("get_state", indices=[i])[0]

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Put environment i into a state of `get_state`."""
        self.call("set_state", np.asarray(state, np.float64), indices=[i])
        self._running[i], self._success[i] = True, False

    def close_extras(self, **kwargs: Any) -> None:
        """End the workers and free their memory."""
        self._finalizer()

    def _open(self) -> list[spaces.Dict]:
        """Wait for all environments, and agree on spaces."""
        answers, failures = wait_for(dict(enumerate(self._workers)), self.start_timeout)
        if failures:
            raise WorkerError({i: f.why for i, f in failures.items()}, self.tasks)
        observed = [checked_space(answers[i][0], self.tasks[i]) for i in range(self.num_envs)]
        first = answers[0][1]
        if odd := [self.tasks[i] for i in range(self.num_envs) if answers[i][1] != first]:
            raise LiberoError(f"the action spaces of {', '.join(odd)} differ from {first} of {self.tasks[0]}")
        for worker, space in zip(self._workers, observed, strict=True):
            worker.share(space)
        self._attached(range(self.num_envs))
        self._common = [k for k, box in observed[0].items() if all(o.spaces.get(k) == box for o in observed)]
        self.single_observation_space = spaces.Dict({key: observed[0][key] for key in self._common})
        self.single_action_space, self._action_size = first, first.shape[0]
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(first, self.num_envs)
        return observed

    def _attached(self, ids: Sequence[int]) -> dict[int, str]:
        answers, failed = self._collect(ids, self.timeout)
        for i in answers:
            self._workers[i].opened = True
        return failed

    def _reopen(self, ids: Sequence[int]) -> dict[int, str]:
        """Wait for workers that were replaced; index -> why not."""
        if not ids:
            return {}
        answers, failed = self._collect(ids, self.start_timeout)
        for i in answers:
            self._workers[i].share(self._spaces[i])
        return failed | self._attached(list(answers))

    def _collect(
        self, ids: Sequence[int], timeout: float, keep_running: bool = False
    ) -> tuple[dict[int, Any], dict[int, str]]:
        """Answers, and why some gave none; those whose process is lost get a new one."""
        asked = {i: self._workers[i] for i in ids}
        try:
            answers, failures = wait_for(asked, timeout)
        except KeyboardInterrupt:
            for worker in asked.values():  # their answers would be taken for those to the next question
                worker.process.kill()
            raise
        for i, failure in failures.items():
            self._abandon(i, failure, keep_running)
        return answers, {i: failure.why for i, failure in failures.items()}

    def _abandon(self, i: int, failure: Failure, keep_running: bool) -> None:
        worker = self._workers[i]
        if failure.lost or not worker.opened:
            worker.restart()
        if failure.lost or not keep_running:
            self._running[i] = False
            for view in worker.shared.views.values() if worker.shared else ():
                view[...] = 0

    def _observe(self) -> dict[str, np.ndarray]:
        views = self._views()
        return {key: np.stack([v[key] for v in views]) for key in self._common}

    def _views(self) -> list[dict[str, np.ndarray]]:
        return [worker.shared.views if worker.shared else {} for worker in self._workers]

    def _info(self) -> dict[str, Any]:
        info: dict[str, Any] = {
            "success": self._success.copy(),
            "progress": [dict(p) for p in self._progress],
        }
        own = [
            {key: view.copy() for key, view in views.items() if key not in self._common}
            for views in self._views()
        ]
        return {**info, "own": own} if any(own) else info

    def _checked(self, outcome: Any, failed: Mapping[int, str]) -> Any:
        if failed:
            raise WorkerError(failed, self.tasks, outcome)
        return outcome

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None or np.isscalar(seed):
            return [None if seed is None else int(seed) + i for i in range(self.num_envs)]  # type: ignore[arg-type]
        if len(seed) != self.num_envs:  # type: ignore[arg-type]
            raise LiberoError(f"seed: expected one or {self.num_envs} seeds, got {len(seed)}")  # type: ignore[arg-type]
        return [None if s is None else int(s) for s in seed]  # type: ignore[union-attr]


def _task_name(spec: EnvSpec) -> str:
    if callable(spec):
        return getattr(spec, "__name__", repr(spec))
    if "task" not in spec:
        raise LiberoError(f"each environment needs a 'task'; got the keys {', '.join(spec) or 'none'}")
    return getattr(spec["task"], "id", str(spec["task"]))
