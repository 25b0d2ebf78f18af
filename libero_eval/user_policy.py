"""A policy of the user's own: an object with `predict`, from `module:function`."""

import ast
import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import BuiltinMethodType, MethodType, ModuleType
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
from lifelong.errors import ConfigError, LifelongError, MissingObservationError, PolicyError
from lifelong.evaluation.environments import Obs
from lifelong.settings.configuration import require_same_module

_WRITE = "write module:function, such as my_policy:make"
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
        self.out = Path("eval") / name.replace(":", ".")

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol with the policy's own image size, if it has one; see `PolicyUnderTest`."""
        own, asked = self._attribute("camera_size", tuple[_Side, _Side] | None, None), self.request.size
        if own and asked:
            raise ConfigError(
                f"--size {asked}: {self.request.policy_name} has a size of its own, camera_size {own[0]} x {own[1]}"
            )
        size = own or ((asked, asked) if asked else None)
        protocol = base if size is None else base.changed({"pixels.render_size": size})
        unlike = [name for name in self.observations if name.startswith(("depth", "segmentation"))]
        if unlike and self._names(protocol) == "original":
            raise ConfigError(
                f"the original's {' and '.join(unlike)} are in other units and numbers: --names native gives "
                f"{self.request.policy_name} this package's"
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
        function = text.removeprefix(module)
        raise LifelongError(
            f"{text}: a module is named without .py: write {Path(module).stem}{function}, in the folder of the file"
        )
    if not all(part.isidentifier() for part in parts):
        raise LifelongError(f"{text}: {module!r} is not a name of a module; {_WRITE}")
    require_same_module(parts[0], sys.path, text)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in {".".join(parts[: i + 1]) for i in range(len(parts))}:
            raise
        raise LifelongError(
            f"{text}: there is no module {error.name}, neither in the current folder ({Path.cwd()}) nor installed; "
            f"type the command in the folder of {error.name}.py"
        ) from error


def source_digest(module: str) -> str | None:
    """Return the digest of the source of a module and of what it imports from its own folder, directly or not.

    Nothing is imported for it. None for a module without a file.
    """
    file = getattr(sys.modules[module], "__file__", None)
    if file is None or not Path(file).is_file():
        return None
    path = Path(file).resolve()
    folder = path.parents[module.count(".") + (path.name == "__init__.py")]
    sources = {module: path.read_bytes()}
    waiting = [*_imports(sources[module], module, path)]
    while waiting:
        name = waiting.pop()
        top, place = name.partition(".")[0], folder.joinpath(*name.split("."))
        files = [one for one in (place.with_suffix(".py"), place / "__init__.py") if one.is_file()]
        own = top == module.partition(".")[0] or not {"site-packages", "dist-packages"} & set(folder.parts)
        if files and own and name not in sources and top not in _PROJECT:
            sources[name] = files[0].read_bytes()
            waiting += _imports(sources[name], name, files[0])
    parts = [part for name in sorted(sources) for part in (name.encode(), sources[name])]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def _imports(source: bytes, name: str, path: Path) -> Iterator[str]:
    """Yield the names of modules that a source may import, packages above them included."""
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):  # it is not of Python
        return
    for node in nodes:
        found = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            kept = name.count(".") + 1 - node.level + (path.name == "__init__.py")
            base = [*(name.split(".")[:kept] if node.level else []), *([node.module] if node.module else [])]
            found = [".".join(base), *(".".join([*base, one]) for one in found)]
        for one in filter(None, found):
            parts = one.split(".")
            yield from (".".join(parts[: i + 1]) for i in range(len(parts)))


def weights_digest(policy: Any) -> str | None:
    """Return the digest of the arrays and networks that an object, its class and its module hold; None for none.

    Attributes, and what functions were made with, are followed a few steps.
    """
    digest = hashlib.sha256()
    seen: dict[int, Any] = {}
    kind = type(policy)
    module = getattr(sys.modules.get(kind.__module__), "__dict__", {})
    counts = [_add_arrays(part, digest, seen) for part in (policy, dict(vars(kind)), dict(module))]
    return digest.hexdigest()[:16] if any(counts) else None


def _add_arrays(value: Any, digest: Any, seen: dict[int, Any], left: int = 8) -> int:
    """Add the arrays in an object to a digest, and return their number; what is kept in `seen` keeps its id."""
    if id(value) in seen or not left or isinstance(value, type | ModuleType):
        return 0
    seen[id(value)] = value
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.nn.Module):
        value = value.state_dict()
    if torch is not None and isinstance(value, torch.Tensor):  # NumPy has no bfloat16
        value = value.detach().cpu()
        value = value if value.is_sparse else value.contiguous().reshape(-1).view(torch.uint8).numpy()
    if hasattr(value, "__array__") and hasattr(value, "dtype"):
        try:
            array = np.ascontiguousarray(value)
            digest.update(f"{array.dtype} {array.shape}".encode())
            digest.update(array.reshape(-1).view(np.uint8).data)
        except (TypeError, ValueError, RuntimeError):  # of objects, or sparse
            return 0
        return 1
    return sum([_add_arrays(part, digest, seen, left - 1) for part in _held(value)])


def _held(value: Any) -> list[Any]:
    """Return what an object holds: its entries, attributes, and, as a function, what it was made with."""
    if isinstance(value, list | tuple):
        return list(value)
    if isinstance(value, Mapping):
        return list(value.values())
    if isinstance(value, partial):
        return [value.func, *value.args, *value.keywords.values()]
    slots = [getattr(kind, "__slots__", ()) for kind in type(value).__mro__]  # each one name, or several
    names = [name for part in slots for name in ([part] if isinstance(part, str) else part)]
    held = [*getattr(value, "__dict__", {}).values(), *(getattr(value, name, None) for name in names)]
    if isinstance(value, MethodType | BuiltinMethodType):
        held.append(value.__self__)
    for cell in getattr(value, "__closure__", None) or ():
        with suppress(ValueError):  # it is empty
            held.append(cell.cell_contents)
    return held
