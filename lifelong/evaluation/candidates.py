"""Policies that can be evaluated: those of runs, and a user's own."""

import argparse
import hashlib
import importlib
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from libero_env.envs.batch import BatchEnv
from libero_env.tasks import Task
from lifelong.data.settings import CAMERAS
from lifelong.errors import LifelongError
from lifelong.evaluation.actors import Actor, CallableActor, PolicyActor
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.protocols import SELECTION, EvalProtocol
from lifelong.evaluation.restore import restore
from lifelong.seeding import generator

ROLLOUT = 4  # first word of the seeds of stochastic policies; those of runs are in lifelong.sequence


class PolicyUnderTest(ABC):
    """A policy to be evaluated.

    Attributes:
        identity: Plain data that identify the policy.
        out: Default folder of the results.
        tasks: Tasks of its run, if it has one.
        selection: Initial states by which it may have been chosen.
        on_cpu: Whether it is a network of this package on the CPU, whose bits depend on its number of threads.
    """

    identity: Mapping[str, Any]
    out: Path
    tasks: Sequence[Task] = ()
    selection: Sequence[int]
    on_cpu: bool = False

    @abstractmethod
    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return a protocol with the policy's own image size and steps."""

    @abstractmethod
    def env(self, task: Task, count: int, protocol: EvalProtocol) -> VectorEnv:
        """Build the environment of a task with the given number of simulations."""

    @abstractmethod
    def actor(
        self, task: Task, states: Sequence[int], protocol: EvalProtocol
    ) -> AbstractContextManager[Actor]:
        """Return the context manager of the task's actor, which starts in the given initial states."""


class RunPolicy(PolicyUnderTest):
    """The policy of a run, evaluated with the image size it was trained on."""

    def __init__(self, args: argparse.Namespace):

        self.args = args
        self.run = restore(Path(args.policy), after=args.after, device=args.device)
        digest = hashlib.sha256(self.run.checkpoint.read_bytes()).hexdigest()[:16]
        self.identity = {"run": str(self.run.path), "after": self.run.learned, "weights": digest}
        self.out = self.run.path / "eval" / f"after_{self.run.learned:02d}"
        self.tasks = self.run.tasks
        self.selection = tuple(self.run.eval.init_states("curve"))
        self.on_cpu = self.run.device.type == "cpu"

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        settings = self.run.eval
        if self.args.protocol == "libero":  # a run may have other values
            base = replace(base, horizon=settings.horizon, settle_steps=settings.settle_steps)
        return replace(base, camera_size=self.run.policy.spec.image_size, original=False)

    def env(self, task: Task, count: int, protocol: EvalProtocol) -> VectorEnv:

        return BatchEnv(
            task,
            count,
            num_threads=self.args.threads,
            cameras=tuple(CAMERAS[view] for view in self.run.policy.spec.views),
            camera_size=protocol.camera_size,
            horizon=protocol.steps(task) + protocol.settle_steps,
            assets=self.args.assets,
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Actor]:

        run = self.run
        draws = [generator(self.args.seed, ROLLOUT, task.index, state) for state in states]
        with run.acting(task) as policy:
            yield PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws)


class UserPolicy(PolicyUnderTest):
    """A user-defined policy; see `lifelong.evaluation.actors.CallableActor` for its interface."""

    def __init__(self, args: argparse.Namespace):

        self.args, self.policy = args, load_callable(args.policy)
        self.cameras = tuple(getattr(self.policy, "cameras", ("agentview", "robot0_eye_in_hand")))
        self.identity = {"policy": args.policy}
        self.out = Path("eval") / args.policy.replace(":", ".")
        self.selection = SELECTION

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        args, size = self.args, tuple(getattr(self.policy, "camera_size", base.camera_size))
        if args.size:
            size = (args.size, args.size)
        original = base.original if args.names is None else args.names == "original"
        return replace(base, camera_size=size, original=original)

    def env(self, task: Task, count: int, protocol: EvalProtocol) -> VectorEnv:

        default = ("rgb", "proprioception", "ee_quat")
        return BatchEnv(
            task,
            count,
            num_threads=self.args.threads,
            cameras=self.cameras,
            camera_size=protocol.camera_size,
            horizon=protocol.steps(task) + protocol.settle_steps,
            observations=tuple(getattr(self.policy, "observations", default)),
            assets=self.args.assets,
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Actor]:

        views = tuple(f"{camera.removeprefix('robot0_')}_rgb" for camera in self.cameras)
        yield CallableActor(self.policy, task.language, views, protocol.original)


def load_callable(text: str) -> Any:
    """Return the result of `module:function`, an object with `predict`. The working directory is searched too.

    Raises:
        LifelongError: The module or function does not exist, or its result has no `predict`.
    """
    module, _, name = text.partition(":")
    folder = os.getcwd()
    added = folder not in sys.path
    if added:
        sys.path.insert(0, folder)
    try:
        make = getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise LifelongError(f"{text}: {error}; write module:function, such as my_policy:make") from error
    finally:
        if added:
            sys.path.remove(folder)
    policy = make()
    if not callable(getattr(policy, "predict", None)):
        raise LifelongError(
            f"{text}() returns a {type(policy).__name__} without predict(observations) -> (B, 7) actions"
        )
    return policy
