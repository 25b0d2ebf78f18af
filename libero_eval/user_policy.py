"""A policy of the user's own: an object with `predict`, from `module:function`."""

import gc
import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from libero_env.envs.checks import checked_numbers
from libero_env.envs.config import Cameras
from libero_env.errors import code_of
from libero_env.tasks import Task
from libero_env.validation import validate
from libero_eval.policies import PolicyUnderTest
from libero_eval.protocols.adapter import ACTION_DIM, ProtocolAdapter, view_of
from libero_eval.protocols.clock import Planner
from libero_eval.protocols.environment import OBSERVATIONS
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import Request
from libero_eval.words import WRITE, no_module, require_module
from lifelong.errors import (
    ConfigError,
    LifelongError,
    MissingObservationError,
    PolicyError,
    require_same_module,
)
from lifelong.evaluation.actors import Obs

_PROJECT = ("libero", "libero_env", "libero_eval", "lifelong")  # whose version is in the result
# Keys of a result's `evaluated` that are not the user's
_STATED = ("policy", "source", "names", "name", "seed", "run", "after", "server", "announced")
_Side = Annotated[int, Field(ge=1, le=4096)]  # pixels
ORIGINAL_NAMES = {
    "agentview_rgb": "agentview_image",
    "eye_in_hand_rgb": "robot0_eye_in_hand_image",
    "joint_states": "robot0_joint_pos",
    "joint_velocities": "robot0_joint_vel",
    "gripper_states": "robot0_gripper_qpos",
    "gripper_velocities": "robot0_gripper_qvel",
    "ee_pos": "robot0_eef_pos",
    "ee_quat": "robot0_eef_quat",
}


class UserPolicy(PolicyUnderTest):
    """A user-defined policy; see `CallableActor` for its interface.

    Its identity is the source of its module and of those beside it that it imports, the arrays and networks that it
    holds, and what it names in an attribute `identity`, plain data: results of different ones are not mixed.
    """

    def __init__(self, request: Request):
        super().__init__(request)
        name = request.policy_name
        self.policy = load_callable(name)
        if request.seed and not _takes_seeds(self.policy):
            raise ConfigError(
                f"--seed {request.seed}: {name} draws by itself; its reset would get seeds with an argument `seeds`"
            )
        self.cameras = self._attribute("cameras", Cameras | None, None)
        self.observations = self._attribute("observations", tuple[str, ...], OBSERVATIONS)
        named = self._attribute("identity", dict[str, Any], {})
        if taken := [key for key in _STATED if key in named]:
            raise PolicyError(
                f"the policy's identity names {taken[0]}, which a result states itself; call it own_{taken[0]}"
            )
        if "weights" not in named and (weights := weights_digest(self.policy)):
            named = {"weights": weights, **named}
        names = {} if request.names is None else {"names": request.names}
        self.identity = {"policy": name, "source": source_digest(name.partition(":")[0]), **named, **names}
        self.place = Path(name.removesuffix(":make").replace(":", "."))

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol with the policy's own image size, if it has one; see `PolicyUnderTest`."""
        own, asked = self._attribute("camera_size", tuple[_Side, _Side] | None, None), self.request.size
        if own and asked:
            raise ConfigError(
                f"--size {asked}: {self.request.policy_name} has a size of its own, camera_size {own[0]} x {own[1]}"
            )
        size = own or ((asked, asked) if asked else None)
        protocol = base if size is None else base.changed({"pixels.render_size": size})
        if self._names(protocol) == "protocol":
            known = {*protocol.pixels.cameras, *OBSERVATIONS}
            if strange := [name for name in (*(self.cameras or ()), *self.observations) if name not in known]:
                raise ConfigError(
                    f"{self.request.policy_name} names {', '.join(strange)}; the inputs of protocol {protocol.name} "
                    f"are images of {' and '.join(protocol.pixels.cameras)}, the state and the instruction: --names "
                    "native gives it this package's observations"
                )
            self.cameras, self.observations = None, OBSERVATIONS
        unlike = [name for name in self.observations if name.startswith(("depth", "segmentation"))]
        if unlike and self._names(protocol) == "original":
            raise ConfigError(
                f"the original's {' and '.join(unlike)} are in other units and numbers: --names native gives "
                f"{self.request.policy_name} this package's"
            )
        if self.request.videos and ("rgb" not in self.observations or self.cameras == ()):
            raise ConfigError(
                f"--videos: {self.request.policy_name} observes no images (cameras, observations)"
            )
        return protocol

    def _names(self, protocol: EvalProtocol) -> str:
        upright = protocol.pixels.orientation == "upright"
        return self.request.names or ("native" if upright else "original")

    @contextmanager
    def planner(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Planner]:
        """Yield what gives the policy its observations under the names it takes."""
        views = tuple(map(view_of, protocol.pixels.cameras if self.cameras is None else self.cameras))
        names, words = self._names(protocol), self.seeds(task, states)
        seeds = tuple(int(np.random.SeedSequence(one).generate_state(1)[0]) for one in words)
        if names == "protocol":
            adapter = ProtocolAdapter(protocol, task)
            yield ProtocolActor(self.policy, views, adapter, protocol.action.replan, seeds=seeds)
        else:
            yield CallableActor(self.policy, views, protocol.prompt(task), names == "original", seeds=seeds)

    def _attribute(self, name: str, kind: Any, default: Any) -> Any:
        """Return an attribute of the policy, or the default where it has none.

        Raises:
            PolicyError: It is of another kind.
        """
        value = getattr(self.policy, name, default)
        return validate(kind, value, prefix=(f"the policy's {name}",), error=PolicyError)


def _takes_seeds(policy: Any) -> bool:
    """Return whether an object's `reset` has an argument `seeds`."""
    try:
        return "seeds" in inspect.signature(policy.reset).parameters
    except (AttributeError, TypeError, ValueError):  # no reset, or not one that can be looked into
        return False


class Observations(dict[str, Any]):
    """Observations by name; a name that is not among them is an error that says which there are."""

    def __missing__(self, name: str) -> Any:
        hint = "protocols with the original's names have no others; --names native gives this package's"
        if name in ORIGINAL_NAMES.values():
            hint = "--names original gives the original's names"
        raise MissingObservationError(f"there is no observation {name!r}, but {', '.join(self)}; {hint}")


def as_original(obs: Obs) -> dict[str, np.ndarray]:
    """Return observations as LIBERO's own environments name them, with flipped images and xyzw quaternions."""
    renamed = {}
    for name, value in obs.items():
        if name.endswith("_rgb"):
            value = value[:, ::-1]
        elif name.endswith("_quat"):
            if name.endswith("_to_ee_quat"):  # of a rotation matrix, so that w is not negative
                value = np.where(value[..., :1] < 0, -value, value)
            value = np.roll(value, -1, axis=-1)
        renamed[ORIGINAL_NAMES.get(name, name.replace("_to_ee_", "_to_robot0_eef_"))] = value
    return renamed


@dataclass
class _UserActor:
    """Calls the user's object; errors in its code name it.

    Attributes:
        policy: The object.
        views: Names of the observed images that recorded rollouts show.
        seeds: A seed for each simulation, for an object whose `reset` takes them.
    """

    policy: Any
    views: tuple[str, ...]
    seeds: tuple[int, ...] = field(default=(), kw_only=True)
    action_dim, observes = ACTION_DIM, "asked"

    def _name(self, method: str) -> str:
        return f"{type(self.policy).__name__}.{method}"

    def _reset(self, instruction: str, num_envs: int) -> None:
        if hasattr(self.policy, "reset"):
            with code_of(f"the policy's {self._name('reset')}"):
                more = {"seeds": list(self.seeds)} if _takes_seeds(self.policy) else {}
                self.policy.reset(instruction, num_envs, **more)

    def _predict(self, observations: Observations, shape: tuple[int, ...] | str) -> np.ndarray:
        """Return what the object predicts, finite numbers of a shape; where that is a text, the caller checks it.

        Raises:
            PolicyError: It predicts something else.
        """
        name = self._name("predict")
        with code_of(f"the policy's {name}"):
            answer = self.policy.predict(observations)
        if hasattr(answer, "detach"):  # of PyTorch
            answer = answer.detach().cpu()
        return checked_numbers(answer, f"the actions of {name}", (shape,), PolicyError)


@dataclass
class CallableActor(_UserActor):
    """A user-defined object with `predict(observations) -> actions`.

    `predict` receives the observations of `libero_env.envs.batch.BatchEnv`, (B, ...) arrays by name, with upright
    images, and the instruction as text under "instruction". Finished episodes keep their rows; actions for them are
    ignored. It returns (B, 7) actions; the gripper opens at -1 and closes at +1. An optional
    `reset(instruction, num_envs)` is called before each task's episodes; if it has an argument `seeds`, with a seed for
    each simulation, which follows from `--seed`, the task and the initial state.

    Attributes:
        instruction: Instruction that the object receives.
        original: Whether observations are those of LIBERO's own environments, see `as_original`.
    """

    instruction: str
    original: bool = False
    replan = 1

    def reset(self, num_envs: int) -> None:
        """Call the object's `reset`, if it has one; see `Planner`."""
        self._reset(self.instruction, num_envs)

    def plan(self, obs: Obs, rows: Sequence[int]) -> np.ndarray:
        """Return the object's actions, each a chunk of one; see `Planner`.

        Raises:
            PolicyError: The actions have the wrong shape, or are not finite.
        """
        observations = as_original(obs) if self.original else obs
        shape = (len(next(iter(obs.values()))), self.action_dim)
        answer = self._predict(Observations(observations, instruction=self.instruction), shape)
        return answer[list(rows), None]


@dataclass
class ProtocolActor(_UserActor):
    """A user-defined object that is given a protocol's inputs, and answers in the protocol's convention.

    Its `predict` receives for all simulations: an array (B, H, W, 3) by name of each camera, `state` (B, 8), and
    `instruction`. It returns (B, 7) actions, or chunks (B, H, 7), of which the protocol executes as many as it says
    before it asks again. On a clock it is called when an episode asks, and what it returns for the others is not used.

    Attributes:
        adapter: Conversion of observations and actions under the protocol.
        replan: Number of actions of a chunk that are executed; None for all.
    """

    adapter: ProtocolAdapter
    replan: int | None

    def reset(self, num_envs: int) -> None:
        """Call the object's `reset`, if it has one; see `Planner`."""
        self._reset(self.adapter.protocol.prompt(self.adapter.task), num_envs)

    def plan(self, obs: Obs, rows: Sequence[int]) -> np.ndarray:
        """Return the object's chunks for some simulations; see `Planner`.

        Raises:
            PolicyError: The actions have the wrong shape, are too few, or are not finite.
        """
        inputs = self.adapter.inputs(obs)
        images = {name: np.stack([one.images[name] for one in inputs]) for name in inputs[0].images}
        states = np.stack([one.state for one in inputs])
        count, dim = len(inputs), self.action_dim
        shapes = f"({count}, {dim}), or chunks ({count}, H, {dim})"
        answer = self._predict(Observations(images, state=states, instruction=inputs[0].prompt), shapes)
        chunks = answer[:, None] if answer.ndim == 2 else answer
        if chunks.ndim != 3 or chunks.shape[::2] != (count, dim):
            raise PolicyError(
                f"the actions of {self._name('predict')}: expected shape {shapes}, got {answer.shape}"
            )
        if answer.ndim == 3 and chunks.shape[1] < (self.replan or 1):
            found = f"{self._name('predict')} returned {chunks.shape[1]} actions"
            raise PolicyError(f"{found}; the protocol executes {self.replan} of them")
        return self.adapter.actions(chunks[list(rows)])


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
            make = getattr(_imported(text), name, None)
        if not callable(make):
            what = "has no function" if make is None else f"has a {type(make).__name__}, not a function,"
            raise LifelongError(f"{text}: module {module} {what} {name}; {WRITE}")
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


def _imported(text: str) -> ModuleType:
    """Return a module; one that it imports itself and that does not exist is an error of its own."""
    module = require_module(text)
    parts = module.split(".")
    require_same_module(parts[0], sys.path, text)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in {".".join(parts[: i + 1]) for i in range(len(parts))}:
            raise
        raise no_module(error.name or module, text) from error


def source_digest(module: str) -> str | None:
    """Return the digest of the source of a module and of what it has imported from its own folder, directly or not.

    None for a module without a file.
    """
    file = getattr(sys.modules[module], "__file__", None)
    if file is None or not Path(file).is_file():
        return None
    path = Path(file).resolve()
    folder = path.parents[module.count(".") + (path.name == "__init__.py")]
    installed = {"site-packages", "dist-packages"} & set(folder.parts)
    sources = {}
    for name, one in list(sys.modules.items()):
        top, place = name.partition(".")[0], Path(getattr(one, "__file__", None) or "").resolve()
        own = top == module.partition(".")[0] or not installed and top not in _PROJECT
        if own and place.suffix == ".py" and place.is_relative_to(folder) and place.is_file():
            sources[place.relative_to(folder).as_posix()] = place.read_bytes()
    parts = [part for name in sorted(sources) for part in (name.encode(), sources[name])]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def weights_digest(policy: Any) -> str | None:
    """Return the digest of the arrays and networks that an object, its class and its module hold; None for none.

    Attributes, and what functions were made with, are followed a few steps.
    """
    kind, seen = type(policy), dict[int, Any]()
    module = getattr(sys.modules.get(kind.__module__), "__dict__", {})
    found = [digest for part in (policy, dict(vars(kind)), dict(module)) for digest in _arrays(part, seen)]
    return hashlib.sha256(b"".join(sorted(found))).hexdigest()[:16] if found else None


def _arrays(value: Any, seen: dict[int, Any], left: int = 16) -> Iterator[bytes]:
    """Yield the digests of the arrays in an object; what is kept in `seen` keeps its id."""
    if id(value) in seen or not left or isinstance(value, type | ModuleType):
        return
    seen[id(value)] = value
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.nn.Module):
        value = value.state_dict()
    if torch is not None and isinstance(value, torch.Tensor):  # NumPy has no bfloat16
        value = value.detach().cpu()
        value = value if value.is_sparse else value.contiguous().reshape(-1).view(torch.uint8).numpy()
    if hasattr(value, "__array__") and hasattr(value, "dtype"):
        with suppress(TypeError, ValueError, RuntimeError):  # of objects, or sparse
            array = np.ascontiguousarray(value)
            digest = hashlib.sha256(f"{array.dtype} {array.shape}".encode())
            digest.update(array.reshape(-1).view(np.uint8).data)
            yield digest.digest()
        return
    held = value.__closure__ or () if isinstance(value, FunctionType) else gc.get_referents(value)
    for part in held:
        yield from _arrays(part, seen, left - 1)
