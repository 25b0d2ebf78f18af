"""Policies that can be evaluated: those of runs, and a user's own."""

import argparse
import hashlib
import importlib
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

from pydantic import Field

from libero_env.errors import code_of
from libero_env.tasks import Task
from libero_env.validation import validate
from libero_eval.protocols.adapter import CardAdapter
from libero_eval.protocols.environment import OBSERVATIONS, make_env, run_protocol
from libero_eval.protocols.packaged import SELECTION
from libero_eval.protocols.protocol import Card
from lifelong.data.settings import CAMERAS
from lifelong.errors import LifelongError, PolicyError
from lifelong.evaluation.actors import Actor, CallableActor, PolicyActor, ProtocolActor
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.restore import restore
from lifelong.seeding import EVALUATION, generator

_WRITE = "write module:function, such as my_policy:make"

_Side = Annotated[int, Field(ge=1, le=4096)]  # pixels


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
    args: argparse.Namespace

    @property
    def simulated(self) -> dict[str, Any]:
        """How the arguments of the command want simulations made, see `make_env`: threads, assets, back end."""
        return {name: getattr(self.args, name) for name in ("threads", "assets", "backend")}

    @abstractmethod
    def protocol(self, base: Card) -> Card:
        """Return the protocol as it is run with the policy, such as with the image size that it was trained on."""

    @abstractmethod
    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:
        """Build the environment of a task with the given number of simulations."""

    @abstractmethod
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> AbstractContextManager[Actor]:
        """Return the context manager of the task's actor, which starts in the given initial states."""


class RunPolicy(PolicyUnderTest):
    """The policy of a run, evaluated with the images it was trained on: their size and drawing."""

    def __init__(self, args: argparse.Namespace):

        self.args = args
        self.run = restore(Path(args.policy), after=args.after, device=args.device, allow=args.allow)
        digest = hashlib.sha256(self.run.checkpoint.read_bytes()).hexdigest()[:16]
        self.identity = {"run": str(self.run.path), "after": self.run.learned, "weights": digest}
        self.out = self.run.path / "eval" / f"after_{self.run.learned:02d}"
        self.tasks = self.run.tasks
        self.selection = tuple(self.run.eval.init_states("curve"))
        self.on_cpu = self.run.device.type == "cpu"

    def protocol(self, base: Card) -> Card:
        """Return the protocol with the run's images and one prediction for each step; see `PolicyUnderTest`."""
        settings, size = self.run.eval, self.run.policy.spec.image_size
        run, assets = self.run, self.args.assets
        own = (settings.horizon, settings.settle_steps, run.robot)
        return run_protocol(base, size, *own, drawing=run.drawing, assets=assets)

    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:

        cameras = tuple(CAMERAS[view] for view in self.run.policy.spec.views)
        return make_env(
            task,
            count,
            protocol,
            cameras=cameras,
            **self.simulated,
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> Iterator[Actor]:

        run = self.run
        draws = [generator(self.args.seed, EVALUATION, task.index, state) for state in states]
        with run.acting(task) as policy:
            yield PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws)


class UserPolicy(PolicyUnderTest):
    """A user-defined policy; see `lifelong.evaluation.actors.CallableActor` for its interface.

    Its module's source is part of its identity, and so is what it names in an attribute `identity`, plain data such as
    the digest of its weights: results of different ones are not mixed.
    """

    def __init__(self, args: argparse.Namespace):

        self.args, self.policy = args, load_callable(args.policy)
        self.cameras = self._own("cameras", tuple[str, ...], ("agentview", "robot0_eye_in_hand"))
        own = self._own("identity", dict[str, Any], {})
        self.identity = {"policy": args.policy, "source": source_digest(args.policy), **own}
        if args.names is not None:
            self.identity |= {"names": args.names}
        self.out = Path("eval") / args.policy.replace(":", ".")
        self.selection = SELECTION

    def protocol(self, base: Card) -> Card:
        """Return the protocol with the policy's own image size, if it has one; see `PolicyUnderTest`."""
        size = self._own("camera_size", tuple[_Side, _Side] | None, None)
        if self.args.size:
            size = (self.args.size, self.args.size)
        return base if size is None else base.changed({"pixels.render_size": tuple(size)})

    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:

        return make_env(
            task,
            count,
            protocol,
            cameras=self.cameras,
            observations=self._own("observations", tuple[str, ...], OBSERVATIONS),
            **self.simulated,
        )

    def _own(self, name: str, kind: Any, default: Any) -> Any:
        """Return an attribute of the policy, or the default where it has none.

        Raises:
            PolicyError: It is of another kind.
        """
        value = getattr(self.policy, name, default)
        return validate(kind, value, prefix=(f"the policy's {name}",), error=PolicyError)

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> Iterator[Actor]:

        views = tuple(f"{camera.removeprefix('robot0_')}_rgb" for camera in self.cameras)
        names = self.args.names or ("native" if protocol.pixels.orientation == "upright" else "original")
        if names == "protocol":
            yield ProtocolActor(self.policy, CardAdapter(protocol, task), protocol.action.replan, views)
        else:
            yield CallableActor(self.policy, protocol.prompt(task), views, names == "original")


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
        with code_of(f"the module {module}"):
            make = getattr(_imported(module, text), name, None)
        if not callable(make):
            what = "has no function" if make is None else f"has a {type(make).__name__}, not a function,"
            raise LifelongError(f"{text}: module {module} {what} {name}; {_WRITE}")
        with code_of(f"{text}()"):
            policy = make()
    finally:
        if added:
            sys.path.remove(folder)
    if not callable(getattr(policy, "predict", None)):
        raise LifelongError(
            f"{text}() returns a {type(policy).__name__} without predict(observations) -> (B, 7) actions"
        )
    return policy


def _imported(module: str, text: str) -> ModuleType:
    """Return a module; one that it imports itself and that does not exist is an error of its own."""
    parts = module.split(".")
    if module.endswith(".py"):
        own = text.removeprefix(module)
        raise LifelongError(
            f"{text}: a module is named without .py: write {Path(module).stem}{own}, in the folder of the file"
        )
    if not all(part.isidentifier() for part in parts):
        raise LifelongError(f"{text}: {module!r} is no name of a module; {_WRITE}")
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in {".".join(parts[: i + 1]) for i in range(len(parts))}:
            raise
        raise LifelongError(
            f"{text}: there is no module {error.name}, neither in the current folder ({Path.cwd()}) nor installed; "
            f"type the command in the folder of {error.name}.py"
        ) from error


def source_digest(text: str) -> str | None:
    """Return the digest of the source of the module in `module:function`; None if it has no file of its own."""
    source = getattr(sys.modules[text.partition(":")[0]], "__file__", None)
    if source is None or not Path(source).is_file():
        return None
    return hashlib.sha256(Path(source).read_bytes()).hexdigest()[:16]
