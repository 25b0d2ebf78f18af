"""A WebSocket server of policies in openpi's protocol.

The metadata are sent first; each observation is answered by a map with `actions` and `server_timing`. An error is sent
as text, its traceback, and ends the connection with code 1011. `GET /healthz` answers `OK`. Source: openpi
`src/openpi/serving/websocket_policy_server.py`.
"""

import asyncio
import hmac
import os
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from typing import Any, Protocol

from libero_eval.servers.codecs import OPENPI
from libero_eval.servers.connections import API_KEY
from libero_eval.servers.packages import need


class Answering(Protocol):
    """One client's episodes."""

    def infer(self, message: Any) -> dict[str, Any]:
        """Return the answer to a request."""

    def close(self) -> None:
        """Forget the client."""


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
        session: Callable[[], Answering],
        *,
        host: str = "127.0.0.1",
        port: int = 8000,
    ):
        self._metadata, self._session = metadata, session
        self._host, self._port = host, port
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._key = os.environ.get(API_KEY)

    async def run(self, on_ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until cancelled.

        Args:
            on_ready: Function called with the port, once connections are accepted.

        Raises:
            OSError: The port is taken.
        """
        serve = need("websockets.asyncio.server").serve
        options = {"compression": None, "max_size": None, "process_request": self._respond}
        async with serve(self._handle, self._host, self._port, **options) as server:
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
                answer = await self._in_worker(partial(self._answer, session, data, last))
                await socket.send(answer)
                last = time.perf_counter() - began
        except closed:
            return
        except Exception:  # noqa: BLE001 - whatever went wrong is for the client to read
            await self._fail(socket, traceback.format_exc())
        finally:
            await self._in_worker(session.close)

    def _answer(self, session: Answering, data: bytes | str, last: float | None) -> bytes:
        if isinstance(data, str):
            data = data.encode()
        request = OPENPI.unpack(data)
        began = time.perf_counter()
        answer = session.infer(request)
        timing = {"infer_ms": 1000 * (time.perf_counter() - began)}
        if last is not None:
            timing["prev_total_ms"] = 1000 * last
        return OPENPI.pack({**answer, "server_timing": timing})

    async def _in_worker(self, work: Callable[[], Any]) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._worker, work)

    async def _fail(self, socket: Any, text: str) -> None:
        """Send an error and close the connection; the client may be gone."""
        try:
            await socket.send(text)
            await socket.close(1011, "Internal server error. Traceback included in previous frame.")
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
