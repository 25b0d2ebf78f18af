"""Policy servers as clients see them: messages as bytes, connections with time limits, and the interface that all have.

Errors name the server. `libero_eval.servers` has one module for each kind of server.
"""

import asyncio
import importlib
import itertools
import math
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from libero_env.errors import MissingPackageError
from libero_env.tasks import Task
from libero_env.text import json_safe, shorten
from libero_eval.protocols.adapter import PolicyInput
from lifelong.errors import CodecError, ConnectionLost, ServerError

T = TypeVar("T")

API_KEY = "LIBERO_API_KEY"  # environment variable with the key that servers ask for
MAX_MESSAGE_BYTES = 4 << 20  # of an answer; chunks of actions have some kB
MAX_PARTS = 10_000  # lists and maps of a message
MAX_DEPTH = 30  # lists and maps within each other
MAX_TEXT = 2000  # characters of a server's error that are shown, its last ones
_END_SECONDS = 10.0  # for the thread of connections to end
_FIRST_DELAY, _LONGEST_DELAY = 0.1, 5.0  # between attempts to connect, [s]
_DISTRIBUTIONS = {"websockets": "websockets", "msgpack": "msgpack", "zmq": "pyzmq"}


def need(module: str) -> Any:
    """Return a module of the extra `servers`, such as `websockets.asyncio.client`.

    Raises:
        MissingPackageError: Its package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = _DISTRIBUTIONS[module.partition(".")[0]]
        raise MissingPackageError(
            f"policy servers need the package {package}, which is not installed",
            "pip install 'libero-lifelong[servers]'",
        ) from error


@dataclass(frozen=True)
class Codec:
    """Messages as bytes: MessagePack, and what a kind of server makes of arrays.

    Attributes:
        name: Name of the server's protocol, for error messages.
        encode: Function that returns plain data for an array or a NumPy scalar.
        decode: Function that returns the value of a decoded map.
    """

    name: str
    encode: Callable[[Any], Any]
    decode: Callable[[Mapping], Any]

    def pack(self, message: Any) -> bytes:
        """Return a message as bytes.

        Raises:
            CodecError: It has a value that the protocol cannot carry.
        """

        def encode(value: Any) -> Any:
            if isinstance(value, np.ndarray | np.generic):
                return self.encode(value)
            raise TypeError(f"a {type(value).__name__} is neither plain data nor an array")

        try:
            return need("msgpack").packb(message, default=encode)
        except (TypeError, ValueError, OverflowError) as error:
            raise CodecError(f"{self.name} cannot carry this message: {error}") from error

    def unpack(self, data: bytes) -> Any:
        """Return the message that bytes hold; its arrays are writable copies.

        Raises:
            CodecError: The bytes are not a message of the protocol.
        """
        parts = itertools.count(1)

        def counted(value: Any) -> Any:
            if next(parts) > MAX_PARTS:
                raise ValueError(f"more than {MAX_PARTS} lists and maps")
            return value

        try:
            found = need("msgpack").unpackb(
                data, object_hook=lambda value: self.decode(counted(value)), list_hook=counted
            )
            _check_depth(found)
        except Exception as error:  # noqa: BLE001 - bytes of a stranger: msgpack and NumPy raise many kinds
            start = bytes(data[:16]).hex(" ")
            raise CodecError(
                f"{len(data)} bytes that are not a message of {self.name} ({type(error).__name__}: "
                f"{shorten(str(error), 200)}); they begin with {start or 'nothing'}"
            ) from error
        return found


def _check_depth(value: Any, left: int = MAX_DEPTH) -> None:
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    if parts and not left:
        raise ValueError(f"lists and maps within each other, more than {MAX_DEPTH} deep")
    for part in parts:
        _check_depth(part, left - 1)


def ending(text: Any) -> str:
    """Return the end of a server's text for a message; it may have any size."""
    said = str(text).strip()
    return said if len(said) <= MAX_TEXT else f"... {said[-MAX_TEXT:]}"


def refuse(dtype: np.dtype, kinds: str) -> None:
    """Check that an array is not of some kinds of NumPy, such as `O`.

    Raises:
        ValueError: It is.
    """
    if dtype.kind in kinds:
        raise ValueError(f"dtype {dtype} is refused")


def array_of(data: Any, dtype: str, shape: Any) -> np.ndarray:
    """Return the array that raw bytes hold, as a copy; bytes and shape must agree."""
    kind, sizes = np.dtype(dtype), tuple(int(n) for n in shape)
    refuse(kind, "VOc")
    if min(sizes, default=0) < 0 or len(data) != math.prod(sizes) * kind.itemsize:
        raise ValueError(f"{len(data)} bytes for shape {sizes} of {kind}")
    return np.frombuffer(data, kind).reshape(sizes).copy()


@dataclass(frozen=True)
class Limits:
    """How long a server is waited for.

    Attributes:
        connect: Time until a connection must be open, attempts included, [s].
        answer: Time until an answer must have come, [s]; the first one may include compiling a model.
        in_flight: Maximum number of requests without an answer; None for one from each simulation.
    """

    connect: float = 30.0
    answer: float = 300.0
    in_flight: int | None = None


@dataclass(frozen=True)
class EpisodeStart:
    """The task of an episode, and the index of the stored state it starts from."""

    task: Task
    init_state: int


class PolicyClient(ABC):
    """A policy server that is asked for actions of many simulations.

    Attributes:
        address: URL of the server.
        announced: What the server says about itself when it is first reached, plain data.
        codec: Encoding of the messages.
    """

    address: str
    announced: Mapping[str, Any]
    codec: ClassVar[Codec]

    @staticmethod
    @abstractmethod
    def stated(announced: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is announced in the words of protocols: `action.chunk` -> value.

        Raises:
            ProtocolMismatchError: The server was made for other conventions than LIBERO's.
        """

    @abstractmethod
    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin episodes, one of each simulation; unfinished earlier ones are dropped."""

    @abstractmethod
    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions of simulations, unchecked; which come first makes no difference.

        Raises:
            ServerError: The server fails, is too late, or sends something else.
            ConnectionLost: A connection breaks.
        """

    @abstractmethod
    def finish(self, simulation: int, success: bool) -> None:
        """Tell the server that an episode is over."""

    @abstractmethod
    def close(self) -> None:
        """Close all connections."""

    def check_same(self, announced: Mapping[str, Any], first: Mapping[str, Any]) -> None:
        """Check that the server announces what it did at first.

        Raises:
            ServerError: It does not.
        """
        if announced != first:
            raise ServerError(
                f"{self.address} announces {shorten(str(announced), 200)}, but at first "
                f"{shorten(str(first), 200)}: another policy is served there now; evaluate it by itself"
            )

    def image(self, given: PolicyInput, camera: str) -> np.ndarray:
        """Return the image of a camera.

        Raises:
            ServerError: The protocol does not have the camera.
        """
        if camera not in given.images:
            raise ServerError(
                f"{self.address} needs images of {camera}; the protocol has {', '.join(given.images)} (pixels.cameras)"
            )
        return given.images[camera]


class LoopThread:
    """An event loop in a thread of its own, so that a server's pings are answered while simulations step."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="policy server", daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Return what a coroutine returns; an interruption cancels it."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        """End the thread; what still runs is cancelled."""
        if not self._loop.is_closed():
            self.run(_cancel_others())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(_END_SECONDS)
            self._loop.close()


class Connection:
    """An open connection.

    Attributes:
        address: URL of the server, for error messages.
        codec: Encoding of the messages.
        limits: How long the server is waited for.
        sent: Number of messages that were sent.
    """

    def __init__(self, socket: Any, address: str, codec: Codec, limits: Limits):
        self._socket = socket
        self._next: asyncio.Task[Any] | None = None  # the message that is waited for
        self.address, self.codec, self.limits, self.sent = address, codec, limits, 0

    async def check_quiet(self) -> None:
        """Check that no message is there that nobody has asked for; it would be taken for an answer to a later request.

        Raises:
            ServerError: There is one.
        """
        self._next = self._next or asyncio.ensure_future(self._socket.recv())
        await asyncio.sleep(0)
        if self._next.done() and not self._next.exception():
            raise ServerError(f"{self.address} sent a message before it was asked; nothing of it is used")

    async def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            CodecError: The protocol cannot carry it.
            ServerError: The server takes nothing in time, or has sent what it was not asked for.
            ConnectionLost: The connection is broken.
        """
        data = self.codec.pack(message)
        await self.check_quiet()
        await self._in_time(self._socket.send(data), "took no request", "")
        self.sent += 1

    async def receive(self, what: str) -> Any:
        """Return the next message: text as it is, bytes decoded.

        Args:
            what: What is waited for, for error messages.

        Raises:
            ServerError: Nothing comes in time, or bytes that are not a message.
            ConnectionLost: The connection is broken.
        """
        waiting, self._next = self._next or self._socket.recv(), None
        data = await self._in_time(waiting, "sent nothing", f" ({what})")
        if isinstance(data, str):
            return data
        try:
            return self.codec.unpack(data)
        except CodecError as error:
            raise ServerError(f"{self.address} sent {error} ({what})") from error

    async def _in_time(self, work: Awaitable[T], failed: str, what: str) -> T:
        try:
            return await asyncio.wait_for(work, self.limits.answer)
        except TimeoutError as error:
            raise ServerError(
                f"{self.address} {failed} within {self.limits.answer:g} s{what}; --timeout sets the limit"
            ) from error
        except need("websockets").exceptions.ConnectionClosed as error:
            closing = error.rcvd or error.sent
            why = f"closed with {closing.code} {closing.reason}".strip() if closing else "broken off"
            raise ConnectionLost(f"the connection to {self.address} was {why}") from error

    async def receive_map(self, what: str) -> Mapping[str, Any]:
        """Return the next message, which must be a map; text is a traceback. See `receive`."""
        return self.as_map(await self.receive(what), what)

    def as_map(self, message: Any, what: str) -> Mapping[str, Any]:
        """Return a message that must be a map.

        Raises:
            ServerError: It is something else; a text is the server's traceback.
        """
        if isinstance(message, str):
            raise ServerError(f"{self.address} failed; its traceback:\n{ending(message)}")
        if not isinstance(message, Mapping):
            raise ServerError(f"{self.address} sent a {type(message).__name__} as {what}; expected a map")
        return message

    async def close(self) -> None:
        """Close the connection; one that is broken is closed already."""
        if self._next is not None:
            self._next.cancel()
            await asyncio.gather(self._next, return_exceptions=True)
        await self._socket.close()


async def connect(address: str, codec: Codec, limits: Limits) -> Connection:
    """Open a connection; a server that is not there yet is waited for, with growing pauses between attempts.

    The environment variable `LIBERO_API_KEY` is sent as openpi's client does: `Authorization: Api-Key KEY`.

    Raises:
        ServerError: The server refuses, or is not there in time.
    """
    client, exceptions = need("websockets.asyncio.client"), need("websockets.exceptions")
    key = os.environ.get(API_KEY)
    options = {
        "additional_headers": {"Authorization": f"Api-Key {key}"} if key else None,
        "compression": None,
        "max_size": MAX_MESSAGE_BYTES,
        "ping_interval": None,  # a server that computes may not answer pings; the time limits decide
        "open_timeout": limits.connect,
    }
    clock, delay = asyncio.get_running_loop().time, _FIRST_DELAY
    deadline = clock() + limits.connect
    while True:
        try:
            return Connection(await client.connect(address, **options), address, codec, limits)
        except exceptions.InvalidStatus as error:
            if error.response.status_code < 500:
                raise ServerError(
                    f"{address} refuses connections: HTTP {error.response.status_code} (401 and 403: set {API_KEY})"
                ) from error
            last: Exception = error
        except exceptions.InvalidURI as error:
            raise ServerError(f"{address} is not an address; write ws://host:port") from error
        except (OSError, TimeoutError, exceptions.InvalidHandshake) as error:
            last = error
        if clock() + delay > deadline:
            raise ServerError(
                f"no policy server at {address} within {limits.connect:g} s ({type(last).__name__}: {last})"
            ) from last
        await asyncio.sleep(delay)
        delay = min(2 * delay, _LONGEST_DELAY)


async def _cancel_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


class WebSocketClient(PolicyClient):
    """A server with one connection for each simulation, since a server may keep state by connection.

    Args:
        address: URL of the server, `ws://host:port`.
        limits: How long the server is waited for.

    Raises:
        ServerError: The server is not there, or says nothing that can be read.
    """

    def __init__(self, address: str, limits: Limits = Limits()):  # noqa: B008 - frozen
        for package in ("websockets", "msgpack"):  # before anything is connected
            need(package)
        self.address, self.limits = address, limits
        self._loop: LoopThread | None = LoopThread()
        self._connections: list[Connection] = []
        self._started: list[float] = []
        try:
            self.announced = json_safe(self._loop.run(self._first()))
        except BaseException:
            self.close()
            raise

    @abstractmethod
    async def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Return what the server says about itself."""

    async def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Tell the server that an episode begins."""

    @abstractmethod
    async def infer(self, connection: Connection, given: PolicyInput) -> Mapping[str, Any]:
        """Return the server's answer, a map with `actions`."""

    async def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Tell the server that an episode is over."""

    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Open a connection for each episode and begin it; see `PolicyClient`.

        Raises:
            ServerError: The server is not there, or announces something else than at first.
        """
        self._loop = self._loop or LoopThread()
        self._loop.run(self._close_connections())
        self._started = [time.monotonic()] * len(episodes)
        self._loop.run(self._open(episodes))

    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions, unchecked; see `PolicyClient`."""
        return self.run(self._ask(inputs))

    def finish(self, simulation: int, success: bool) -> None:
        """Tell the server that an episode is over, and close its connection; see `PolicyClient`."""
        seconds = time.monotonic() - self._started[simulation]
        outcome = {"metrics": {"success": success}, "elapsed_sec": round(seconds, 3)}
        connection = self._connections[simulation]
        self.run(self.end(connection, outcome))
        self.run(connection.check_quiet())
        self.run(connection.close())

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._loop is not None:
            self._loop.run(self._close_connections())
            self._loop.close()
            self._loop = None

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Return what a coroutine returns in the thread of the connections."""
        assert self._loop is not None, "open was called"
        return self._loop.run(work)

    async def _first(self) -> Mapping[str, Any]:
        connection = await connect(self.address, self.codec, self.limits)
        try:
            return await self.greet(connection)
        finally:
            await connection.close()

    async def _open(self, episodes: Sequence[EpisodeStart]) -> None:
        for episode in episodes:
            connection = await connect(self.address, self.codec, self.limits)
            self._connections.append(connection)  # what is open is closed, also after an error
            self.check_same(json_safe(await self.greet(connection)), self.announced)
            await self.begin(connection, episode)

    async def _ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        slots = asyncio.Semaphore(self.limits.in_flight or len(inputs) or 1)

        async def one(simulation: int, given: PolicyInput) -> Any:
            async with slots:
                answer = await self.infer(self._connections[simulation], given)
            if "actions" not in answer:
                raise ServerError(
                    f"{self.address} answered a map with {shorten(str(sorted(map(str, answer)) or 'nothing'))} "
                    f"and without `actions`, in {self.codec.name}'s protocol"
                )
            return answer["actions"]

        try:
            async with asyncio.TaskGroup() as group:
                tasks = {i: group.create_task(one(i, given)) for i, given in inputs.items()}
        except BaseExceptionGroup as group_error:  # the other tasks are cancelled
            raise group_error.exceptions[0] from None
        return {i: task.result() for i, task in tasks.items()}

    async def _close_connections(self) -> None:
        connections, self._connections = self._connections, []
        await asyncio.gather(*(c.close() for c in connections), return_exceptions=True)
