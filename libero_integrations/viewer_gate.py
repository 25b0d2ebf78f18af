"""Who may use a viewer in the browser: pages from its own address, with values that its controls offer.

viser lets any page of the browser connect, under any name of this machine, and passes on what a client says. Here each
request, and each message of a client, is looked at before viser sees it.
"""

import http
import math
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

_SENT = ("GuiUpdateMessage", "ViewerCameraMessage")  # what clients say that has an effect here
_MAX_BYTES, _MAX_TEXT, _MAX_NUMBER = 1 << 20, 1000, 1e6  # of a message, of its texts and numbers


class Gate:
    """What requests and messages are let through.

    Args:
        host: Address that is listened on.

    Attributes:
        controls: Function that returns the control of an identifier, None where there is none.
    """

    def __init__(self, host: str):
        self._names = {"localhost", "127.0.0.1", "::1", host.lower()}
        self._any_address = not _is_loopback(host)
        if self._any_address:
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self.controls: Callable[[str], Any] = lambda _: None

    def refusal(self, headers: Any) -> str:
        """Return why a request with these headers is refused, "" where it is not."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return f"the Host {hosts!r:.200} is not this viewer's address\n"
        own = [f"{scheme}://{hosts[0].lower()}" for scheme in ("http", "https")]
        if any(origin.lower() not in own for origin in origins):
            return f"the Origin {origins!r:.200} is not this viewer's address\n"
        return ""

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        is_address = self._any_address and _is_address(name)  # an address cannot be bound anew
        return name in self._names or is_address

    def checked(self, content: object) -> bytes | None:
        """Return a message with values that the control offers; None for one that has no effect here.

        Raises:
            ValueError: It is broken, or has a value of another kind than the control offers.
        """
        import msgspec
        from viser.infra import Message

        if not isinstance(content, bytes):
            raise ValueError("it is text")
        try:
            told = msgspec.msgpack.decode(content)
            if told["type"] not in _SENT:
                return None
            _check_numbers(told)
            Message.deserialize(content)
            if told["type"] != "GuiUpdateMessage":
                return content
            if (control := self.controls(told["uuid"])) is None:
                return None
            (value,) = (told["updates"][name] for name in {"value", *told["updates"]})
        except (msgspec.MsgspecError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as why:
            raise ValueError("it is not a message of the viewer") from why
        return msgspec.msgpack.encode({**told, "updates": {"value": offered(control, value)}})


def offered(control: Any, value: Any) -> Any:
    """Return the value that a control takes for one that a client asks for: within its limits.

    Raises:
        ValueError: It is of another kind, or not among the control's options.
    """
    now, options = control.value, getattr(control, "options", None)
    low, high = getattr(control, "min", None), getattr(control, "max", None)
    if options is not None:
        taken = isinstance(value, str) and value in options
    elif isinstance(now, bool | str):
        taken = isinstance(value, type(now))
    elif isinstance(now, tuple):
        taken = isinstance(value, list) and len(value) == len(now) and all(map(_is_number, value))
        value = (
            [type(old)(_within(new, low, high)) for old, new in zip(now, value, strict=True)] if taken else ()
        )
    else:
        taken = _is_number(value)
        value = type(now)(_within(value, low, high)) if taken else now
    if not taken:
        raise ValueError(f"{value!r:.80} is not a value of {control.label}")
    return value


def _within(value: float, low: float | None, high: float | None) -> float:
    return min(max(value, -_MAX_NUMBER if low is None else low), _MAX_NUMBER if high is None else high)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _check_numbers(value: Any) -> None:
    """Raise ValueError for a number that is not finite, and a text that is too long."""
    if isinstance(value, Mapping):
        value = [*value.keys(), *value.values()]
    if isinstance(value, list | tuple):
        for part in value:
            _check_numbers(part)
    elif (isinstance(value, float) and not math.isfinite(value)) or len(str(value)) > _MAX_TEXT:
        raise ValueError(f"{value!r:.80}")


def _is_address(name: str) -> bool:
    try:
        return bool(ip_address(name))
    except ValueError:
        return False


def _is_loopback(host: str) -> bool:
    return host.lower() == "localhost" or (_is_address(host) and ip_address(host).is_loopback)


@contextmanager
def gated(gate: Gate) -> Iterator[None]:
    """Let servers of viser that are started within the context listen behind a gate: it has no option for it."""
    from websockets.asyncio import server

    plain: Any = server.serve

    def serve(
        handler: Callable[[Any], Awaitable[None]], *args: Any, process_request: Any, **options: Any
    ) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if reason := gate.refusal(request.headers):
                return connection.respond(http.HTTPStatus.FORBIDDEN, reason)
            return process_request(connection, request)

        async def handle(connection: Any) -> None:
            receive = connection.recv

            async def recv() -> bytes:
                while True:
                    try:
                        if (message := gate.checked(await receive())) is not None:
                            return message
                    except ValueError as error:
                        # after which `receive` ends the handler
                        await connection.close(1008, str(error)[:100])

            connection.recv = recv
            await handler(connection)

        return plain(handle, *args, process_request=answer, **{**options, "max_size": _MAX_BYTES})

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = plain  # type: ignore[misc]
