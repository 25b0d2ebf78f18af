"""Policy servers of the tests: their handlers are given, the rest is as openpi's, vla-eval's and GR00T's."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zmq
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from libero_eval.servers.openpi import OPENPI
from libero_eval.servers.serving import PolicyServer, ServedPolicy
from libero_integrations.servers.groot import ACTION, GROOT
from libero_integrations.servers.vla_eval import VLA_EVAL

MODALITIES = {
    "video": ["image", "wrist_image"],
    "state": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"],
    "action": list(ACTION),
    "language": ["annotation.human.action.task_description"],
}


@contextmanager
def running(main: Callable[[Callable[[int], None]], Any]) -> Iterator[int]:
    """Run a server in a thread; yield its port. `main` takes a function that it calls with the port."""
    loop, ready, ports = asyncio.new_event_loop(), threading.Event(), []

    def on_ready(port: int) -> None:
        ports.append(port)
        ready.set()

    task = loop.create_task(main(on_ready))

    def work() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            ready.set()

    thread = threading.Thread(target=work)
    thread.start()
    assert ready.wait(60) and ports, "the server did not start"
    try:
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(60)
        loop.close()


@contextmanager
def web_socket(handler: Callable[[Any], Any]) -> Iterator[str]:
    """Run a server whose connections are handled by a coroutine; yield its address."""

    async def quiet(socket: Any) -> None:
        try:
            await handler(socket)
        except ConnectionClosed:
            return

    async def main(on_ready: Callable[[int], None]) -> None:
        async with serve(quiet, "127.0.0.1", 0, compression=None, max_size=None) as server:
            on_ready(server.sockets[0].getsockname()[1])
            await server.serve_forever()

    with running(main) as port:
        yield f"ws://127.0.0.1:{port}"


def openpi(answer: Callable[[Any], Any], metadata: dict | None = None) -> Any:
    """Return a server that sends what `answer` returns for an observation: bytes and text as they are."""

    async def handler(socket: Any) -> None:
        await socket.send(OPENPI.pack(metadata or {}))
        async for data in socket:
            found = answer(OPENPI.unpack(data))
            await socket.send(found if isinstance(found, bytes | str) else OPENPI.pack(found))

    return web_socket(handler)


def vla_eval(answer: Callable[[dict], Any], hello: dict, heard: list) -> Any:
    """Return a server that answers observations; everything that is heard is appended to a list."""

    async def handler(socket: Any) -> None:
        async for data in socket:
            message = VLA_EVAL.unpack(data)
            heard.append(message)
            kind, payload = message["type"], None
            if kind == "hello":
                payload = hello
            elif kind == "observation":
                kind, payload = "action", answer(message["payload"])
                kind = "error" if "error" in payload else kind
            if payload is not None:
                reply = {"type": kind, "payload": payload, "seq": message["seq"], "timestamp": 0.0}
                await socket.send(VLA_EVAL.pack(reply))

    return web_socket(handler)


def groot_endpoints(get_action: Callable[..., Any], **changes: list[str]) -> dict[str, Callable[..., Any]]:
    """Return the endpoints of a GR00T server; `changes` are other keys of modalities."""
    config = lambda keys: {"delta_indices": [0], "modality_keys": keys}  # noqa: E731
    modalities = {
        name: {"__ModalityConfig_class__": True, "as_json": config(keys)}
        for name, keys in (MODALITIES | changes).items()
    }
    return {
        "ping": lambda: {"status": "ok"},
        "get_modality_config": lambda: modalities,
        "reset": lambda options: {},
        "get_action": get_action,
    }


def flat(actions: np.ndarray) -> list:
    """GR00T's answer with actions (B, H, 7)."""
    return [{f"action.{key}": actions[..., i : i + 1].astype(np.float32) for i, key in enumerate(ACTION)}, {}]


@contextmanager
def groot(endpoints: dict[str, Callable[..., Any]]) -> Iterator[str]:
    """Run a server that answers requests to endpoints as GR00T's does, errors included; yield its address."""
    context = zmq.Context()
    socket = context.socket(zmq.REP)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    stopping = threading.Event()

    def work() -> None:
        while not stopping.is_set():
            if not socket.poll(20):
                continue
            request = GROOT.unpack(socket.recv())
            try:
                answer = endpoints[request["endpoint"]](**(request.get("data") or {}))
            except Exception as error:  # noqa: BLE001 - theirs sends any error's text
                answer = {"error": str(error)}
            socket.send(answer if isinstance(answer, bytes) else GROOT.pack(answer))
        socket.close(0)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        stopping.set()
        thread.join(60)
        context.term()


@contextmanager
def served(policy: ServedPolicy) -> Iterator[str]:
    """Serve a run's policy; yield the address."""
    server = PolicyServer(policy.metadata, policy.session, port=0)
    with running(server.run) as port:
        yield f"ws://127.0.0.1:{port}"
