"""Rollouts in a process of their own, beside training or others in this one."""

from collections.abc import Callable, Hashable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from typing import Any, TypeVar

import cloudpickle
import torch

from libero_env.parallel import spawn_pool
from lifelong.evaluation.environments import EnvPool
from lifelong.policies.base import Policy
from lifelong.training.precision import keep_freed_memory

Outcome = TypeVar("Outcome")


class RolloutProcess:
    """A process with environments of its own that runs rollouts one after the other; it starts with the first.

    A policy acts there with the weights that it has when it is sent, on as many threads as here: to the same bits.
    As a context manager it is waited for, and killed after an error here, which does not wait for rollouts.

    Args:
        envs: Environments of this process; those of the other are built as they are.
    """

    def __init__(self, envs: EnvPool):
        self._envs = envs
        self._pool: ProcessPoolExecutor | None = None

    def submit(
        self, run: Callable[..., Outcome], policy: Policy, env: Hashable, *args: Any, **options: Any
    ) -> Callable[[], Outcome]:
        """Send rollouts, and return a function that waits for their outcome.

        Args:
            run: Function of the policy, the environment and further arguments, such as `rollout`.
            policy: Policy on the CPU.
            env: Key of the environment.
        """
        if self._pool is None:
            self._pool = spawn_pool(1)
            self._pool.submit(_begin, cloudpickle.dumps(self._envs.empty()), torch.get_num_threads())
        content = cloudpickle.dumps((run, policy, env, args, options))
        done: Future[Outcome] = self._pool.submit(_roll_out, content)
        return done.result

    def __enter__(self) -> "RolloutProcess":
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> None:
        failed_here = kind is not None and not issubclass(kind, BrokenExecutor)
        if self._pool is not None:
            self._pool.__exit__(KeyboardInterrupt if failed_here else kind, *error)


_envs: EnvPool  # of the process that runs them


def _begin(envs: bytes, threads: int) -> None:
    global _envs
    keep_freed_memory()
    torch.set_num_threads(threads)
    _envs = cloudpickle.loads(envs)


def _roll_out(content: bytes) -> Any:
    run, policy, env, args, options = cloudpickle.loads(content)
    return run(policy, _envs.get(env), *args, **options)
