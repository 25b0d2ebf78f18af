"""The interface to policy servers, and the servers of openpi and vla-eval behind it, which talk WebSocket."""

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from libero_env.tasks import Task
from libero_eval.servers.codecs import OPENPI, VLA_EVAL, Codec
from libero_eval.servers.connections import Connection, Limits, LoopThread, connect
from lifelong.errors import ServerError
from lifelong.evaluation.inputs import PolicyInput

VLA_EVAL_VERSION = "0.8.0"  # of the harness whose messages these are


@dataclass(frozen=True)
class EpisodeStart:
    """The task of an episode, and the index of the stored state it starts from."""

    task: Task
    init_state: int


class Wire(Protocol):
    """A policy server that is asked for actions of many simulations.

    Attributes:
        address: URL of the server.
        announced: What the server says about itself: openpi's metadata, vla-eval's hello, GR00T's modality
            configuration.
    """

    address: str
    announced: Mapping[str, Any]

    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin episodes, one of each simulation; unfinished earlier ones are dropped."""

    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions of simulations, unchecked; which come first makes no difference.

        Raises:
            ServerError: The server fails, is too late, or sends something else.
            ConnectionLost: A connection breaks.
        """

    def finish(self, simulation: int, success: bool) -> None:
        """Tell the server that an episode is over."""

    def close(self) -> None:
        """Close all connections."""


class Dialect(ABC):
    """What a kind of server is told on a connection, and what it answers.

    Attributes:
        codec: Encoding of the messages.
    """

    codec: Codec

    @abstractmethod
    async def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Return what the server says about itself."""

    @abstractmethod
    async def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Tell the server that an episode begins."""

    @abstractmethod
    async def infer(
        self, connection: Connection, given: PolicyInput, announced: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Return the server's answer, a map."""

    @abstractmethod
    async def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Tell the server that an episode is over."""


@dataclass
class WebSocketWire:
    """A server with one connection for each simulation, since a server may keep state by connection; see `Wire`.

    Attributes:
        address: URL of the server.
        dialect: What the server is told.
        limits: How long the server is waited for.
        announced: What the server said about itself when it was first reached.
    """

    address: str
    dialect: Dialect
    limits: Limits = Limits()
    announced: Mapping[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        self._loop: LoopThread | None = LoopThread()
        self._connections: list[Connection] = []
        self._started: list[float] = []
        try:
            self.announced = self._loop.run(self._first())
        except BaseException:
            self.close()
            raise

    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Open a connection for each episode and begin it; see `Wire`.

        Raises:
            ServerError: The server is not there, or announces something else than at first.
        """
        if self._loop is None:
            self._loop = LoopThread()
        self._loop.run(self._close_connections())
        self._started = [time.monotonic()] * len(episodes)
        self._connections = self._loop.run(self._open(episodes))

    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions, unchecked; see `Wire`."""
        assert self._loop is not None, "open was called"
        return self._loop.run(self._ask(inputs))

    def finish(self, simulation: int, success: bool) -> None:
        """Tell the server that an episode is over, and close its connection; see `Wire`."""
        assert self._loop is not None, "open was called"
        seconds = time.monotonic() - self._started[simulation]
        outcome = {"metrics": {"success": success}, "elapsed_sec": round(seconds, 3)}
        self._loop.run(self.dialect.end(self._connections[simulation], outcome))

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._loop is not None:
            self._loop.run(self._close_connections())
            self._loop.close()
            self._loop = None

    async def _first(self) -> Mapping[str, Any]:
        connection = await connect(self.address, self.dialect.codec, self.limits)
        try:
            return await self.dialect.greet(connection)
        finally:
            await connection.close()

    async def _open(self, episodes: Sequence[EpisodeStart]) -> list[Connection]:
        opened: list[Connection] = []
        self._connections = opened  # what is open is closed, also after an error
        for episode in episodes:
            connection = await connect(self.address, self.dialect.codec, self.limits)
            opened.append(connection)
            again = await self.dialect.greet(connection)
            if not same(again, self.announced):
                raise ServerError(
                    f"{self.address} announces {summary(again)}, but at first {summary(self.announced)}: "
                    "another policy is served there now; evaluate it by itself"
                )
            await self.dialect.begin(connection, episode)
        return opened

    async def _ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        slots = asyncio.Semaphore(self.limits.in_flight or len(inputs) or 1)

        async def one(simulation: int, given: PolicyInput) -> Any:
            async with slots:
                answer = await self.dialect.infer(self._connections[simulation], given, self.announced)
            if "actions" not in answer:
                raise ServerError(
                    f"{self.address} answered a map with {sorted(map(str, answer)) or 'nothing'} "
                    f"and without `actions`, in {self.dialect.codec.name}'s protocol"
                )
            return answer["actions"]

        with first_error():
            async with asyncio.TaskGroup() as group:
                tasks = {i: group.create_task(one(i, given)) for i, given in inputs.items()}
        return {i: task.result() for i, task in tasks.items()}

    async def _close_connections(self) -> None:
        connections, self._connections = self._connections, []
        await asyncio.gather(*(c.close() for c in connections), return_exceptions=True)


class OpenpiDialect(Dialect):
    """openpi's policy server: metadata first, then an answer to each observation; text is a traceback.

    Source: openpi `src/openpi/serving/websocket_policy_server.py` and `examples/libero/main.py`. Nothing says that an
    episode begins; the connection is new.
    """

    codec = OPENPI

    async def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Return the metadata that the server sends first."""
        return _map(await connection.receive("its metadata"), connection, "metadata")

    async def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Do nothing: a connection has one episode."""

    async def infer(
        self, connection: Connection, given: PolicyInput, announced: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Return the server's answer to an observation under openpi's names for LIBERO."""
        observation: dict[str, Any] = {
            "observation/image": camera_image(given, "agentview", connection.address),
            "prompt": given.prompt,
        }
        if given.state.size:  # some protocols have none
            observation["observation/state"] = given.state
        if "robot0_eye_in_hand" in given.images:
            observation["observation/wrist_image"] = given.images["robot0_eye_in_hand"]
        await connection.send(observation)
        return await self.receive(connection)

    async def receive(self, connection: Connection) -> Mapping[str, Any]:
        """Return the server's answer.

        Raises:
            ServerError: It is a traceback, or no map.
        """
        return _map(await connection.receive("actions"), connection, "answer")

    async def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Close the connection, which has no further episode."""
        await connection.close()


class VlaEvalDialect(Dialect):
    """vla-eval's model server, wire version 1: hello both ways, episodes with start and end, numbered messages.

    Source: vla-eval 0.8.0, `vla_eval/{connection,protocol/messages}.py` and `vla_eval/benchmarks/libero/benchmark.py`.
    """

    codec = VLA_EVAL

    def __init__(self) -> None:
        self._numbers: dict[Connection, int] = {}

    async def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Exchange hellos and return the server's."""
        hello = {"harness_version": VLA_EVAL_VERSION, "protocol_version": 1, "benchmark": "libero"}
        number = await self._send(connection, "hello", hello)
        return await self._receive(connection, "hello", number)

    async def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Send the start of an episode with the task, as the harness does; the server does not answer."""
        task = episode.task
        about = {
            "name": task.language,
            "suite": task.suite,
            "task_id": task.index,
            "episode_idx": episode.init_state,
        }
        await self._send(connection, "episode_start", {"task": about})

    async def infer(
        self, connection: Connection, given: PolicyInput, announced: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Return the server's answer to an observation with what its hello asks for."""
        wanted = announced.get("observation_params") or {}
        images = {"agentview": camera_image(given, "agentview", connection.address)}
        if wanted.get("send_wrist_image"):
            images["wrist"] = camera_image(given, "robot0_eye_in_hand", connection.address)
        observation: dict[str, Any] = {"images": images, "task_description": given.prompt}
        if wanted.get("send_state") and given.state.size:
            observation |= {"states": given.state, **given.extra}
        number = await self._send(connection, "observation", observation)
        found = await self._receive(connection, "action", number)
        return {"actions": found["action"]} if "action" in found and "actions" not in found else found

    async def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Send the outcome of the episode and close the connection."""
        await self._send(connection, "episode_end", dict(outcome))
        self._numbers.pop(connection, None)
        await connection.close()

    async def _send(self, connection: Connection, kind: str, payload: dict[str, Any]) -> int:
        number = self._numbers[connection] = self._numbers.get(connection, 0) + 1
        await connection.send({"type": kind, "payload": payload, "seq": number, "timestamp": time.time()})
        return number

    async def _receive(self, connection: Connection, kind: str, number: int) -> Mapping[str, Any]:
        message = _map(await connection.receive(kind), connection, kind)
        lacking = [key for key in ("type", "payload", "seq") if key not in message]
        if lacking:
            raise ServerError(f"{connection.address} sent a message without {', '.join(lacking)}")
        if message["type"] == "error":
            payload = message["payload"]
            said = payload.get("error", payload) if isinstance(payload, Mapping) else payload
            raise ServerError(f"{connection.address} failed: {said}")
        if message["type"] != kind or message["seq"] != number:
            raise ServerError(
                f"{connection.address} sent {message['type']} with seq {message['seq']}; expected {kind} with {number}"
            )
        return _map(message["payload"], connection, f"payload of {kind}")


def camera_image(given: PolicyInput, camera: str, address: str) -> np.ndarray:
    """Return the image of a camera.

    Raises:
        ServerError: The protocol does not have the camera.
    """
    if camera not in given.images:
        raise ServerError(
            f"{address} needs images of {camera}; the protocol has {', '.join(given.images)} (pixels.cameras)"
        )
    return given.images[camera]


def _map(message: Any, connection: Connection, what: str) -> Mapping[str, Any]:
    """Return a message that must be a map; text is an error's traceback.

    Raises:
        ServerError: It is something else.
    """
    if isinstance(message, str):
        raise ServerError(f"{connection.address} failed; its traceback:\n{message.rstrip()}")
    if not isinstance(message, Mapping):
        raise ServerError(f"{connection.address} sent a {type(message).__name__} as {what}; expected a map")
    return message


@contextmanager
def first_error() -> Iterator[None]:
    """Raise the first error of a group of tasks by itself; the other tasks are cancelled."""
    try:
        yield
    except BaseExceptionGroup as group:
        raise group.exceptions[0] from None


def same(a: Any, b: Any) -> bool:
    """Return whether two announcements are equal, arrays included."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and np.array_equal(a, b)


def plain(value: Any) -> Any:
    """Return an announcement as plain data for a result file: arrays as lists, bytes as text."""
    if isinstance(value, Mapping):
        return {plain(k) if isinstance(k, bytes) else str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def summary(announced: Mapping[str, Any], length: int = 200) -> str:
    """Return an announcement as text of a limited length, for error messages."""
    text = str(plain(announced))
    return text if len(text) <= length else f"{text[:length]}..."
