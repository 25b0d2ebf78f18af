"""A run's policy for clients in openpi's protocol: the server, what it announces, and the episodes of a client.

The metadata are sent first; each observation is answered by a map with `actions` and `server_timing`. An error is sent
as text, in one line, and ends the connection with code 1011; tracebacks are for the operator. `GET /healthz` answers
`OK`. Source: openpi `src/openpi/serving/websocket_policy_server.py`.

An episode begins with the first request on a connection, with another `prompt` or `task`, and with a request that has
`reset: true`; nothing else. Each client has a history and, for stochastic policies, generators of its own.
"""

import asyncio
import copy
import hmac
import math
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from http import HTTPStatus
from itertools import count
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.errors import LiberoError, require_known
from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.tasks import Task, get_suite, suite_names
from libero_env.text import printable, shorten, shown
from libero_env.validation import validate
from libero_eval.servers.openpi import OPENPI
from libero_eval.servers.transport import API_KEY, need
from lifelong.algorithms.base import Algorithm
from lifelong.data.settings import CAMERAS, LOW_DIM_KEYS
from lifelong.errors import PolicyError, ServerError
from lifelong.evaluation.actors import PolicyActor
from lifelong.evaluation.restore import LoadedRun
from lifelong.results.provenance import installed_versions
from lifelong.seeding import EVALUATION, generator

SERVER, FORMAT = "libero-lifelong", 1  # the first entries of what is announced
PREFIX = "observation/"
_SERVED = 5  # first word of the seeds of episodes whose client sends none
# names of openpi's LIBERO observations, and what of a policy's inputs follows from them
_OPENPI_IMAGES = {"agentview_rgb": "image", "eye_in_hand_rgb": "wrist_image"}
_OPENPI_STATE = {"ee_pos": slice(0, 3), "gripper_states": slice(6, 8)}
MAX_ROWS = 100  # of a request; a task has fifty initial states
MAX_WORDS = 1000  # characters of an instruction
_KEYS = ("prompt", "task", "instruction", "reset", "seed", "plan")  # of a request, beside the observation


class _Array(TypedDict):
    dtype: str
    shape: Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(min_length=1, max_length=3)]


class _Actions(_Array):
    chunk: Literal[1]
    replan: Literal[1]


class Announced(TypedDict):
    """What `libero serve` announces to every client."""

    server: str
    format: int
    versions: dict[str, str]
    run: str
    after: Annotated[int, Field(ge=0)]
    weights: Annotated[str, Field(min_length=1)]
    protocol: str
    horizon: int
    settle_steps: int
    drawing: str | None
    robot: str
    selection: tuple[Annotated[int, Field(ge=0, lt=NUM_INIT_STATES)], ...]
    observation: dict[str, _Array]
    images: Literal["upright: first row on top, not mirrored"]
    actions: _Actions
    replan: Annotated[int, Field(ge=1)]
    gripper: Literal["opens at -1, closes at +1"]
    openpi_names: bool
    tasks: dict[str, str]
    reset: str


def announced_run(about: Mapping[str, Any], address: str) -> Announced:
    """Return the metadata of `libero serve`, checked.

    Raises:
        ServerError: They are of another format, or something is missing or of another kind.
    """
    if about.get("format") != FORMAT:
        raise ServerError(
            f"{address} is of format {shown(about.get('format'))}; this version reads {FORMAT}: "
            "serve the run with the version that evaluates it"
        )
    run: Announced = validate(Announced, about, source=f"the metadata of {address}", error=ServerError)
    views = [key for key, one in run["observation"].items() if key.removeprefix(PREFIX) in CAMERAS]
    known = {PREFIX + name for name in (*CAMERAS, *LOW_DIM_KEYS)}
    if (
        run["observation"].keys() - known
        or not views
        or any(len(run["observation"][v]["shape"]) != 3 for v in views)
    ):
        raise ServerError(
            f"the metadata of {address}: observation must have images, and only {', '.join(sorted(known))}"
        )
    return run


@dataclass(frozen=True)
class Request:
    """A client's observation.

    Attributes:
        obs: (B, ...) arrays under the names of `libero_env.envs.batch.BatchEnv`.
        rows: Whether the client sent a leading axis B; otherwise B is 1.
        task: Task that is acted on.
        reset: Whether an episode begins with this request.
        seeds: Words from which the generator of each row is made, if the client sent them.
        plan: Rows of which chunks are asked for; None for the next action of each.
    """

    obs: Mapping[str, np.ndarray]
    rows: bool
    task: Task
    reset: bool
    seeds: Sequence[Sequence[int]] | None
    plan: Sequence[int] | None


class ServedPolicy:
    """A run's policy, for any number of clients.

    Args:
        seed: Seed of the generators of episodes whose client sends none.
    """

    def __init__(self, run: LoadedRun, *, seed: int = 0):
        self.run, self.seed = run, seed
        self._sessions = count()

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """What is announced to every client, plain data."""
        run, spec = self.run, self.run.policy.spec
        images: dict[str, Any] = {
            view: {"dtype": "uint8", "shape": [*spec.image_size, 3]} for view in spec.views
        }
        readings = {name: {"dtype": "float64", "shape": [size]} for name, size in spec.proprio.items()}
        return {
            "server": SERVER,
            "format": FORMAT,
            "versions": installed_versions(),
            "run": run.path.name,
            "after": run.learned,
            "weights": run.weights_digest,
            "protocol": "libero",
            "horizon": run.eval.horizon,
            "settle_steps": run.eval.settle_steps,
            "drawing": run.data.drawing,
            "robot": run.data.robot,
            "selection": list(run.eval.init_states("curve")),
            "observation": {PREFIX + name: about for name, about in (images | readings).items()},
            "images": "upright: first row on top, not mirrored",
            "actions": {"dtype": "float64", "shape": [1, spec.action_dim], "chunk": 1, "replan": 1},
            "replan": run.policy.execute,
            "gripper": "opens at -1, closes at +1",
            "openpi_names": not self._lacking(),
            "tasks": {task.id: task.language for task in run.tasks},
            "reset": "an episode begins with a connection, another prompt or task, or reset: true",
        }

    def session(self) -> "Session":
        """Return the episodes of a new client."""
        return Session(self, next(self._sessions))

    def beginning(self, task: Task, init_state: int) -> dict[str, Any]:
        """Return the entries of a request with which an episode begins that has the random numbers of `libero eval`."""
        words = [self.seed, EVALUATION, task.index, init_state]
        return {"reset": True, "task": task.id, "prompt": task.language, "seed": words}

    def own_copy(self) -> LoadedRun:
        """Return the run with a policy that acts by itself; weights are shared where the algorithm changes none."""
        policy, algorithm = self.run.policy, self.run.algorithm
        shared: dict[int, Any] = {}
        if type(algorithm).policy_for is Algorithm.policy_for:
            shared = {id(t): t for t in (*policy.parameters(), *policy.buffers())}
        policy, algorithm = copy.deepcopy((policy, algorithm), shared)
        return replace(self.run, policy=policy, algorithm=algorithm)

    def read(self, message: Any, before: Task | None) -> Request:
        """Return a client's message as a request.

        Args:
            before: Task of the client's last request.

        Raises:
            PolicyError: A key is missing, or a value has the wrong type, dtype or shape.
            UnknownNameError: A key is not known.
        """
        if not isinstance(message, Mapping):
            raise PolicyError(f"a request is a map of names and values, not a {type(message).__name__}")
        for key in message:
            if not str(key).startswith(PREFIX):  # of an observation, what the policy does not see may be sent
                require_known("key of a request", str(key), _KEYS)
        if PREFIX + "image" in message and PREFIX + self.run.policy.spec.views[0] not in message:
            message = self._from_openpi(message)
        spec = self.run.policy.spec
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(spec.views, (*spec.image_size, 3))
        shapes |= {name: (size,) for name, size in spec.proprio.items()}
        rows = _array(message.get(PREFIX + spec.views[0], 0), PREFIX + spec.views[0]).ndim == 4
        obs = {name: _checked(message, name, shape, rows) for name, shape in shapes.items()}
        if len({len(value) for value in obs.values()}) > 1:
            raise PolicyError(
                f"numbers of rows differ: { {name: len(value) for name, value in obs.items()} }"
            )
        task = self._task(message, before)
        seeds, reset = message.get("seed"), message.get("reset", False)
        if seeds is not None:
            seeds = _seeds(seeds, len(next(iter(obs.values()))), rows)
        if not isinstance(reset, bool | np.bool_):
            raise PolicyError("reset is neither true nor false")
        plan, places = message.get("plan"), range(len(next(iter(obs.values()))))
        if plan is not None and not (
            isinstance(plan, list) and all(type(i) is int and i in places for i in plan)
        ):
            raise PolicyError(f"plan is {shown(plan)}; valid: a list of rows, from 0 to {len(places) - 1}")
        return Request(obs, rows, task, bool(reset), seeds, plan)

    def _task(self, message: Mapping[str, Any], before: Task | None) -> Task:
        """Return the task that a request names by `task`, `suite/index`, or by its instruction, `prompt`.

        `instruction` is what the policy is told instead of the task's own words.
        """
        prompt, name, words = (_words(message, key) for key in ("prompt", "task", "instruction"))
        if prompt is None and name is None and before is not None:
            return before if words is None else replace(before, language=words)
        by_id = {task.id: task for task in self.run.tasks}
        if name is not None:
            tasks = [by_id[name]] if name in by_id else [t for t in _tasks() if t.id == name]
        else:
            tasks = [t for t in self.run.tasks if t.language == prompt]
            tasks = tasks or [t for t in _tasks() if t.language == prompt]
        if len(tasks) == 1 and prompt in (None, tasks[0].language):
            return tasks[0] if words is None else replace(tasks[0], language=words)
        if len(tasks) > 1:
            ids = ", ".join(t.id for t in tasks)
            raise PolicyError(
                f"several tasks have the instruction {prompt!r}; send one of them as `task`: {ids}"
            )
        valid = "; ".join(f"{t.id}: {t.language}" for t in self.run.tasks)
        raise PolicyError(f"no task with prompt {prompt!r} and task {name!r}. The run's tasks: {valid}")

    def _lacking(self) -> list[str]:
        """Return the policy's inputs that do not follow from openpi's observations of LIBERO."""
        spec = self.run.policy.spec
        return [n for n in spec.views if n not in _OPENPI_IMAGES] + [
            n for n in spec.proprio if n not in _OPENPI_STATE
        ]

    def _from_openpi(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return a request under openpi's names for LIBERO under the policy's own names.

        openpi turns images by 180 degrees from the simulator's bottom-up rows: they are upright, and mirrored.
        """
        spec = self.run.policy.spec
        if lacking := self._lacking():
            names = ", ".join(PREFIX + name for name in (*spec.views, *spec.proprio))
            raise PolicyError(
                f"this policy needs {', '.join(lacking)}, which observation/image, observation/wrist_image and "
                f"observation/state do not hold; send {names}"
            )
        request = {k: v for k, v in message.items() if not str(k).startswith(PREFIX)}
        for view in spec.views:
            image = _checked(message, _OPENPI_IMAGES[view], (*spec.image_size, 3), False)[0]
            request[PREFIX + view] = image[:, ::-1]
        if spec.proprio:
            state = _checked(message, "state", (8,), False)[0]
            request |= {PREFIX + name: state[_OPENPI_STATE[name]] for name in spec.proprio}
        return request


class Session:
    """The episodes of one client: a policy with its own history.

    Args:
        number: Number of the client, from 0.
    """

    def __init__(self, served: ServedPolicy, number: int):
        self._served, self._number = served, number
        self._run: LoadedRun | None = None
        self._stack, self._episodes = ExitStack(), 0
        self._actor: PolicyActor | None = None
        self._task: Task | None = None
        self._rows = 0

    def infer(self, message: Any) -> dict[str, Any]:
        """Return the answer to a request: `actions` (1, 7) float64, or (B, 1, 7) for B rows; with `plan`, their chunks.

        Raises:
            PolicyError: The request is not valid, or its actions are not finite.
        """
        request = self._served.read(message, self._task)
        rows = len(next(iter(request.obs.values())))
        if self._actor is None or request.reset or self._task != request.task:
            self._begin(request, rows)
        elif rows != self._rows:
            raise PolicyError(
                f"{rows} rows in an episode that began with {self._rows}; begin another with reset: true"
            )
        assert self._actor is not None
        if request.plan is not None:
            actions = self._actor.plan(request.obs, request.plan)
        else:
            actions = self._actor.act(request.obs)[:, None]
        if not np.isfinite(actions).all():
            raise PolicyError("the policy answers this observation with actions that are not finite")
        return {"actions": actions if request.rows or request.plan is not None else actions[0]}

    def close(self) -> None:
        """Forget the client."""
        self._stack.close()
        self._actor = self._run = None

    def _begin(self, request: Request, rows: int) -> None:
        self._stack.close()
        self._run = run = self._run or self._served.own_copy()
        seeds = request.seeds
        if seeds is None:
            words = (self._served.seed, _SERVED, self._number, self._episodes)
            seeds = [(*words, row) for row in range(rows)]
        policy = self._stack.enter_context(run.acting(request.task))
        draws = [generator(*words) for words in seeds]
        actor = PolicyActor(policy, run.embed(request.task), run.device, run.eval.precision, draws)
        actor.reset(rows)
        self._actor, self._task, self._rows = actor, request.task, rows
        self._episodes += 1


def _tasks() -> list[Task]:
    tasks = (task for name in suite_names() for task in get_suite(name).tasks)
    return list({task.id: task for task in tasks}.values())  # suites of all tasks hold those of others


def _words(message: Mapping[str, Any], key: str) -> str | None:
    """Return a text of a request; None if it has none."""
    text = message.get(key)
    if text is not None and not (isinstance(text, str) and len(text) <= MAX_WORDS):
        raise PolicyError(f"{key} is not a text of at most {MAX_WORDS} characters")
    return text


def _array(value: Any, key: str) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise PolicyError(f"{key} is not an array ({error})") from None


def _checked(message: Mapping[str, Any], name: str, shape: tuple[int, ...], rows: bool) -> np.ndarray:
    """Return an array of a request with a leading axis, (B, *shape)."""
    key, image = PREFIX + name, len(shape) == 3
    if key not in message:
        names = shorten(", ".join(sorted(str(k) for k in message)) or "nothing", 500)
        raise PolicyError(f"the request lacks {key}; it has {names}")
    value = _array(message[key], key)
    expected = f"({'B, ' if rows else ''}{', '.join(map(str, shape))})"
    wanted = "u" if image else "fiu"
    batch = value if rows else value[None]
    if value.dtype.kind not in wanted or (image and value.dtype != np.uint8):
        raise PolicyError(f"{key} has dtype {value.dtype}; valid: {'uint8' if image else 'floats'}")
    if batch.shape[1:] != shape or not 1 <= len(batch) <= MAX_ROWS:
        raise PolicyError(f"{key} has shape {value.shape}; this policy's is {expected}")
    if not image and not np.isfinite(batch).all():
        raise PolicyError(f"{key} has values that are not finite")
    return batch


def _seeds(seeds: Any, count: int, rows: bool) -> list[tuple[int, ...]]:
    """Return the words of each row's seed: a list of integers, or one such list for each row."""
    words = _array(seeds if rows else [seeds], "seed")
    if words.ndim != 2 or words.dtype.kind not in "iu" or len(words) != count or (words < 0).any():
        raise PolicyError(
            f"seed is {shown(seeds)}; valid: integers from 0, as a list, or a list for each of {count} rows"
        )
    return [tuple(map(int, row)) for row in words]


class PolicyServer:
    """Serves clients at the same time, each with a session of its own; requests are computed one after another.

    While a request is computed, other connections are opened, and pings and health checks answered. If the environment
    variable `LIBERO_API_KEY` is set, clients must send it: `Authorization: Api-Key KEY`.

    Args:
        metadata: What every client is sent first, plain data.
        session: Function that returns the session of a new client.
        host: Address to listen on; `0.0.0.0` for all of the machine's.
        port: Port to listen on; 0 for a free one.
    """

    def __init__(
        self,
        metadata: dict[str, Any],
        session: Callable[[], Session],
        *,
        host: str = "127.0.0.1",
        port: int = 8000,
    ):
        self._metadata, self._session = metadata, session
        self._host, self._port = host, port
        self._key = os.environ.get(API_KEY)

    async def run(self, on_ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until cancelled.

        Args:
            on_ready: Function called with the port, once connections are accepted.

        Raises:
            ServerError: The address cannot be listened on.
        """
        serve = need("websockets.asyncio.server").serve
        row = sum(8 * math.prod(one["shape"]) for one in self._metadata["observation"].values())
        most = (1 << 20) + MAX_ROWS * row  # of a request, [bytes]
        options = {"compression": None, "max_size": most, "max_queue": 1}
        loop = asyncio.get_running_loop()
        loop.set_default_executor(ThreadPoolExecutor(1, thread_name_prefix="policy"))  # one request at a time
        try:
            server = await serve(
                self._handle, self._host, self._port, process_request=self._respond, **options
            )
        except OSError as error:
            raise ServerError(
                f"--host {self._host} --port {self._port} cannot be listened on: {error.strerror}; --port 0 takes a "
                "free port"
            ) from error
        async with server:
            on_ready(server.sockets[0].getsockname()[1])
            await server.serve_forever()

    async def _handle(self, socket: Any) -> None:
        closed = need("websockets").exceptions.ConnectionClosed
        session = self._session()
        try:
            await socket.send(OPENPI.pack(self._metadata))
            last: float | None = None
            while True:
                data = await socket.recv()
                began = time.perf_counter()
                answer = await asyncio.to_thread(self._answer, session, data, last)
                await socket.send(answer)
                last = time.perf_counter() - began
        except closed:
            return
        except Exception as error:  # noqa: BLE001 - whatever went wrong ends this client only
            await self._fail(socket, error)
        finally:
            await asyncio.to_thread(session.close)

    def _answer(self, session: Session, data: bytes | str, last: float | None) -> bytes:
        if isinstance(data, str):
            data = data.encode()
        request = OPENPI.unpack(data)
        began = time.perf_counter()
        answer = session.infer(request)
        timing = {"infer_ms": 1000 * (time.perf_counter() - began)}
        if last is not None:
            timing["prev_total_ms"] = 1000 * last
        return OPENPI.pack({**answer, "server_timing": timing})

    async def _fail(self, socket: Any, error: Exception) -> None:
        """Send an error in one line, tell the operator, and close the connection; the client may be gone."""
        told = isinstance(error, LiberoError)
        text = (
            f"{type(error).__name__}: {error}"
            if told
            else f"{type(error).__name__} in the server; its operator sees where"
        )
        seen = text if told else "".join(traceback.format_exception(error))
        print(printable(f"client {socket.remote_address}: {seen}"), file=sys.stderr, flush=True)
        try:
            await socket.send(text)
            await socket.close(1011, "Internal server error. Its text is in the previous frame.")
        except need("websockets").exceptions.ConnectionClosed:
            return

    def _respond(self, connection: Any, request: Any) -> Any:
        """Answer health checks, and refuse clients without the key."""
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "")
        if self._key and not hmac.compare_digest(given.encode(), f"Api-Key {self._key}".encode()):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "send the header Authorization: Api-Key KEY\n")
        return None
