"""Policy servers as clients see them: messages as bytes, connections with time limits, and the interface that all have.

Errors name the server. Each kind of server has a module of its own; see `CLIENTS` in `libero_eval.servers.policy`.
"""

import os
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from socket import SHUT_RDWR
from typing import Any, ClassVar

import numpy as np

from libero_env.errors import need
from libero_env.tasks import Task
from libero_env.text import json_safe, shorten
from libero_eval.protocols.adapter import PolicyInput
from libero_eval.servers.codec import Codec, ending
from lifelong.errors import CodecError, ConnectionLost, ServerError

API_KEY = "LIBERO_API_KEY"  # environment variable with the key that servers ask for
MAX_MESSAGE_BYTES = 4 << 20  # of an answer; chunks of actions have some kB
_CLOSE_SECONDS = 1.0  # for a server to take note that a connection is closed
_FIRST_DELAY, _LONGEST_DELAY = 0.1, 5.0  # between attempts to connect, [s]


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
        needs_replan: Whether its answers are chunks, of which the protocol must say how much is executed.
    """

    address: str
    announced: Mapping[str, Any]
    codec: ClassVar[Codec]
    needs_replan: ClassVar[bool] = True

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


class Connection:
    """An open connection, whose pings are answered while simulations step.

    Args:
        stack: What closes it.

    Attributes:
        address: URL of the server, for error messages.
        codec: Encoding of the messages.
        limits: How long the server is waited for.
        sent: Number of messages that were sent.
    """

    def __init__(self, socket: Any, stack: ExitStack, address: str, codec: Codec, limits: Limits):
        self._socket, self._stack = socket, stack
        self.address, self.codec, self.limits, self.sent = address, codec, limits, 0

    def check_quiet(self) -> None:
        """Check that no message is there that nobody has asked for; it would be taken for an answer to a later request.

        Raises:
            ServerError: There is one.
        """
        with suppress(TimeoutError, need("websockets").exceptions.ConnectionClosed):
            self._socket.recv(timeout=0)
            raise ServerError(f"{self.address} sent a message before it was asked; nothing of it is used")

    def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            CodecError: The protocol cannot carry it.
            ServerError: The server takes nothing in time, or has sent what it was not asked for.
            ConnectionLost: The connection is broken.
        """
        data = self.codec.pack(message)
        self.check_quiet()
        late = threading.Event()

        def give_up() -> None:
            late.set()
            self._socket.socket.shutdown(SHUT_RDWR)

        timer = threading.Timer(self.limits.answer, give_up)
        timer.daemon = True
        timer.start()
        try:
            self._socket.send(data)
        except need("websockets").exceptions.ConnectionClosed as error:
            raise (self._late("took no request") if late.is_set() else self._lost(error)) from error
        finally:
            timer.cancel()
        self.sent += 1

    def receive(self, what: str) -> Any:
        """Return the next message: text as it is, bytes decoded.

        Args:
            what: What is waited for, for error messages.

        Raises:
            ServerError: Nothing comes in time, or bytes that are not a message.
            ConnectionLost: The connection is broken.
        """
        try:
            data = self._socket.recv(timeout=self.limits.answer)
            return data if isinstance(data, str) else self.codec.unpack(data)
        except TimeoutError as error:
            raise self._late("sent nothing", f" ({what})") from error
        except need("websockets").exceptions.ConnectionClosed as error:
            raise self._lost(error) from error
        except CodecError as error:
            raise ServerError(f"{self.address} sent {error} ({what})") from error

    def _late(self, failed: str, what: str = "") -> ServerError:
        seconds = f"{self.limits.answer:g} s{what}"
        return ServerError(f"{self.address} {failed} within {seconds}; --timeout sets the limit")

    def _lost(self, error: Any) -> ConnectionLost:
        closing = error.rcvd or error.sent
        why = f"closed with {closing.code} {closing.reason}".strip() if closing else "broken off"
        return ConnectionLost(f"the connection to {self.address} was {why}")

    def receive_map(self, what: str) -> Mapping[str, Any]:
        """Return the next message, which must be a map; text is a traceback. See `receive`."""
        return self.as_map(self.receive(what), what)

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

    def close(self) -> None:
        """Close the connection; one that is broken is closed already."""
        self._stack.close()


def connect(address: str, codec: Codec, limits: Limits) -> Connection:
    """Open a connection; a server that is not there yet is waited for, with growing pauses between attempts.

    The environment variable `LIBERO_API_KEY` is sent as openpi's client does: `Authorization: Api-Key KEY`.

    Raises:
        ServerError: The server refuses, or is not there in time.
    """
    client, exceptions = need("websockets.sync.client"), need("websockets.exceptions")
    key = os.environ.get(API_KEY)
    options = {
        "additional_headers": {"Authorization": f"Api-Key {key}"} if key else None,
        "compression": None,
        "max_size": MAX_MESSAGE_BYTES,
        "ping_interval": None,  # a server that computes may not answer pings; the time limits decide
        "open_timeout": limits.connect,
        "close_timeout": _CLOSE_SECONDS,
    }
    deadline, delay = time.monotonic() + limits.connect, _FIRST_DELAY
    while True:
        try:
            with ExitStack() as stack:
                socket = stack.enter_context(client.connect(address, **options))
                return Connection(socket, stack.pop_all(), address, codec, limits)
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
        if time.monotonic() + delay > deadline:
            raise ServerError(
                f"no policy server at {address} within {limits.connect:g} s ({type(last).__name__}: {last})"
            ) from last
        time.sleep(delay)
        delay = min(2 * delay, _LONGEST_DELAY)


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
        self._connections: list[Connection] = []
        self._started = 0.0
        with closing(connect(address, self.codec, limits)) as connection:
            self.announced = json_safe(self.greet(connection))

    @abstractmethod
    def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Return what the server says about itself."""

    def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Tell the server that an episode begins."""

    @abstractmethod
    def send(self, connection: Connection, given: PolicyInput) -> None:
        """Send an observation."""

    @abstractmethod
    def receive(self, connection: Connection) -> Mapping[str, Any]:
        """Return the server's answer to an observation, a map with `actions`."""

    def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Tell the server that an episode is over."""

    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Open a connection for each episode and begin it; see `PolicyClient`.

        Raises:
            ServerError: The server is not there, or announces something else than at first.
        """
        self.close()
        self._started = time.monotonic()
        for episode in episodes:
            connection = connect(self.address, self.codec, self.limits)
            self._connections.append(connection)  # what is open is closed, also after an error
            self.check_same(json_safe(self.greet(connection)), self.announced)
            self.begin(connection, episode)

    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions, unchecked; see `PolicyClient`."""
        actions: dict[int, Any] = {}
        waiting: deque[int] = deque()
        for i, given in inputs.items():
            if len(waiting) == self.limits.in_flight:
                self._take(waiting, actions)
            self.send(self._connections[i], given)
            waiting.append(i)
        while waiting:
            self._take(waiting, actions)
        return actions

    def _take(self, waiting: deque[int], actions: dict[int, Any]) -> None:
        """Add the answer of the simulation that waits longest."""
        answer = self.receive(self._connections[waiting[0]])
        if "actions" not in answer:
            raise ServerError(
                f"{self.address} answered a map with {shorten(str(sorted(map(str, answer)) or 'nothing'))} "
                f"and without `actions`, in {self.codec.name}'s protocol"
            )
        actions[waiting.popleft()] = answer["actions"]

    def finish(self, simulation: int, success: bool) -> None:
        """Tell the server that an episode is over, and close its connection; see `PolicyClient`."""
        seconds = time.monotonic() - self._started
        connection = self._connections[simulation]
        self.end(connection, {"metrics": {"success": success}, "elapsed_sec": round(seconds, 3)})
        connection.check_quiet()
        connection.close()

    def close(self) -> None:
        """Close all connections."""
        while self._connections:
            self._connections.pop().close()
