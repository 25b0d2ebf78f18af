"""A server that answers with any bytes, at any pace."""

import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


def answer(body: bytes = b"", *headers: str, status: str = "200 OK") -> bytes:
    """An answer of HTTP with the length of its body."""
    lines = [f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", "Connection: close", *headers, "", ""]
    return "\r\n".join(lines).encode() + body


@contextmanager
def serve(*answers: bytes | Sequence[bytes]) -> Iterator[str]:
    """Yield the address of a server that gives each connection the next answer, and the last one ever after.

    Args:
        answers: Bytes, or several, 50 ms after each other.
    """
    done = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=_run, args=(listener, answers, done), daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        done.set()
    thread.join(1)


def _run(listener: socket.socket, answers: Sequence[bytes | Sequence[bytes]], done: threading.Event) -> None:
    count = 0
    while not done.is_set():
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        found = answers[min(count, len(answers) - 1)]
        count += 1
        with connection:
            try:
                connection.recv(1 << 16)
                for part in [found] if isinstance(found, bytes) else found:
                    connection.sendall(part)
                    if not isinstance(found, bytes):
                        time.sleep(0.05)
                    if done.is_set():
                        return
            except OSError:
                continue
