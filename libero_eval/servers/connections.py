"""WebSocket connections to a policy server: opened with back-off, with time limits, and errors that name the server."""

import asyncio
import os
import threading
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

from libero_eval.servers.codecs import Codec
from libero_eval.servers.packages import need
from lifelong.errors import ConnectionLost, ServerError, WireError

T = TypeVar("T")

API_KEY = "LIBERO_API_KEY"  # environment variable with the key that servers ask for
MAX_MESSAGE_BYTES = 256 << 20  # of a message that is received; policies send less than 1 MiB
_END_SECONDS = 10.0  # for the thread of connections to end
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
    """

    def __init__(self, socket: Any, address: str, codec: Codec, limits: Limits):
        self._socket = socket
        self.address, self.codec, self.limits = address, codec, limits

    async def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            WireError: The protocol cannot carry it.
            ServerError: The server takes nothing in time.
            ConnectionLost: The connection is broken.
        """
        data = self.codec.pack(message)
        try:
            await asyncio.wait_for(self._socket.send(data), self.limits.answer)
        except TimeoutError as error:
            raise ServerError(
                f"{self.address} took no request within {self.limits.answer:g} s; --timeout sets the limit"
            ) from error
        except need("websockets").exceptions.ConnectionClosed as error:
            raise self._lost(error) from error

    async def receive(self, what: str) -> Any:
        """Return the next message: text as it is, bytes decoded.

        Args:
            what: What is waited for, for error messages.

        Raises:
            ServerError: Nothing comes in time, or bytes that are no message.
            ConnectionLost: The connection is broken.
        """
        try:
            data = await asyncio.wait_for(self._socket.recv(), self.limits.answer)
        except TimeoutError as error:
            raise ServerError(
                f"{self.address} sent nothing within {self.limits.answer:g} s ({what}); --timeout sets the limit"
            ) from error
        except need("websockets").exceptions.ConnectionClosed as error:
            raise self._lost(error) from error
        if isinstance(data, str):
            return data
        try:
            return self.codec.unpack(data)
        except WireError as error:
            raise ServerError(f"{self.address} sent {error} ({what})") from error

    async def close(self) -> None:
        """Close the connection; one that is broken is closed already."""
        await self._socket.close()

    def _lost(self, error: Any) -> ConnectionLost:
        closing = error.rcvd or error.sent
        why = f"closed with {closing.code} {closing.reason}".strip() if closing else "broken off"
        return ConnectionLost(f"the connection to {self.address} was {why}")


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
            raise ServerError(f"{address} is no address; write ws://host:port") from error
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
