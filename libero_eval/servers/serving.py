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
from typing import Any

import numpy as np

from libero_env.errors import LiberoError, require_known
from libero_env.tasks import Task, get_suite, suite_names
from libero_env.text import printable, shorten, shown
from libero_eval.servers.openpi import OPENPI
from libero_eval.servers.policy import SERVER
from libero_eval.servers.transport import API_KEY, need
from lifelong.algorithms.base import Algorithm
from lifelong.errors import PolicyError, ServerError
from lifelong.evaluation.actors import PolicyActor
from lifelong.evaluation.restore import LoadedRun
from lifelong.results.provenance import installed_versions
from lifelong.seeding import generator

FORMAT = 1  # of what is announced
PREFIX = "observation/"
_SERVED = 5  # first word of the seeds of episodes whose client sends none
# names of openpi's LIBERO observations, and what of a policy's inputs follows from them
_OPENPI_IMAGES = {"agentview_rgb": "image", "eye_in_hand_rgb": "wrist_image"}
_OPENPI_STATE = {"ee_pos": slice(0, 3), "gripper_states": slice(6, 8)}
MAX_WORDS = 1000  # characters of an instruction
_KEYS = ("prompt", "task", "instruction", "reset", "seed")  # of a request, beside the observation


@dataclass(frozen=True)
class Request:
    """A client's observation.

    Attributes:
        obs: (1, ...) arrays under the names of `libero_env.envs.batch.BatchEnv`.
        task: Task that is acted on.
        reset: Whether an episode begins with this request.
        seed: Words from which the episode's generator is made, if the client sent them.
    """

    obs: Mapping[str, np.ndarray]
    task: Task
    reset: bool
    seed: Sequence[int] | None


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
            "gripper": "opens at -1, closes at +1",
            "openpi_names": not self._lacking(),
            "tasks": {task.id: task.language for task in run.tasks},
            "reset": "an episode begins with a connection, another prompt or task, or reset: true",
        }

    def session(self) -> "Session":
        """Return the episodes of a new client."""
        return Session(self, next(self._sessions))

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
        obs = {name: _checked(message, name, shape) for name, shape in shapes.items()}
        seed, reset = message.get("seed"), message.get("reset", False)
        if not isinstance(reset, bool | np.bool_):
            raise PolicyError("reset is neither true nor false")
        words = None if seed is None else _seed(seed)
        return Request(obs, self._task(message, before), bool(reset), words)

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
            image = _checked(message, _OPENPI_IMAGES[view], (*spec.image_size, 3))[0]
            request[PREFIX + view] = image[:, ::-1]
        if spec.proprio:
            state = _checked(message, "state", (8,))[0]
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

    def infer(self, message: Any) -> dict[str, Any]:
        """Return the answer to a request: `actions` (1, 7) float64.

        Raises:
            PolicyError: The request is not valid, or its actions are not finite.
        """
        request = self._served.read(message, self._task)
        if self._actor is None or request.reset or self._task != request.task:
            self._begin(request)
        assert self._actor is not None
        actions = self._actor.act(request.obs)
        if not np.isfinite(actions).all():
            raise PolicyError("the policy answers this observation with actions that are not finite")
        return {"actions": actions}

    def close(self) -> None:
        """Forget the client."""
        self._stack.close()
        self._actor = self._run = None

    def _begin(self, request: Request) -> None:
        self._stack.close()
        self._run = run = self._run or self._served.own_copy()
        words = request.seed or (self._served.seed, _SERVED, self._number, self._episodes, 0)
        policy = self._stack.enter_context(run.acting(request.task))
        actor = PolicyActor(
            policy, run.embed(request.task), run.device, run.eval.precision, [generator(*words)]
        )
        actor.reset(1)
        self._actor, self._task = actor, request.task
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


def _checked(message: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of a request with a leading axis, (1, *shape)."""
    key, image = PREFIX + name, len(shape) == 3
    if key not in message:
        names = shorten(", ".join(sorted(str(k) for k in message)) or "nothing", 500)
        raise PolicyError(f"the request lacks {key}; it has {names}")
    value = _array(message[key], key)
    if value.dtype.kind not in ("u" if image else "fiu") or (image and value.dtype != np.uint8):
        raise PolicyError(f"{key} has dtype {value.dtype}; valid: {'uint8' if image else 'floats'}")
    if value.shape != shape:
        raise PolicyError(f"{key} has shape {value.shape}; this policy's is {shape}")
    if not image and not np.isfinite(value).all():
        raise PolicyError(f"{key} has values that are not finite")
    return value[None]


def _seed(seed: Any) -> tuple[int, ...]:
    words = _array(seed, "seed")
    if words.ndim != 1 or words.dtype.kind not in "iu" or not len(words) or (words < 0).any():
        raise PolicyError(f"seed is {shown(seed)}; valid: a list of integers from 0")
    return tuple(map(int, words))


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
        need("msgpack")  # before anything is listened to
        serve = need("websockets.asyncio.server").serve
        sent = sum(8 * math.prod(one["shape"]) for one in self._metadata["observation"].values())
        most = (1 << 20) + sent  # of a request, [bytes]
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
