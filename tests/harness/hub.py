"""As much of the Hugging Face Hub as a download needs: listing, heads, files with ranges; and ways to go wrong."""

import hashlib
import json
import re
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Hub(ThreadingHTTPServer):
    """A server of one data set; the `large` files are stored by their SHA-256, others are git blobs."""

    daemon_threads = True

    def __init__(self, repo: str, revision: str, files: dict[str, bytes], large: set[str]):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repo, self.revision, self.files, self.large = repo, revision, dict(files), large
        self.cut_once: dict[str, int] = {}  # file -> bytes after which the connection drops, the next time
        self.corrupt: Counter[str] = Counter()  # file -> how many more times its content arrives changed
        self.got: list[tuple[str, str | None]] = []  # file, range asked for

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


@contextmanager
def serve_hub(
    repo: str, revision: str, files: dict[str, bytes], large: set[str] = frozenset()
) -> Iterator[Hub]:
    """Yield a running server."""
    with Hub(repo, revision, files, large) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def git_digest(content: bytes) -> str:
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def do_HEAD(self):
        self._answer(head=True)

    def do_GET(self):
        self._answer(head=False)

    def _answer(self, head):
        server, path = self.server, self.path.partition("?")[0]
        base = f"/api/datasets/{server.repo}"
        if path == f"{base}/tree/{server.revision}":
            return self._json([self._entry(*item) for item in server.files.items()])
        if path in (f"{base}/revision/{server.revision}", base):
            siblings = [{"rfilename": name} for name in server.files]
            return self._json({"id": server.repo, "sha": server.revision, "siblings": siblings})
        found = re.fullmatch(rf"/datasets/{server.repo}/resolve/{server.revision}/(.*)", path)
        if not found or found[1] not in server.files:
            return self._send(404, b"", {"X-Error-Code": "EntryNotFound"})
        return self._file(found[1], head)

    def _file(self, name, head):
        server, content = self.server, self.server.files[name]
        large = name in server.large
        etag = hashlib.sha256(content).hexdigest() if large else git_digest(content)
        headers = {"X-Repo-Commit": server.revision, "ETag": f'"{etag}"', "Accept-Ranges": "bytes"}
        if large:
            headers |= {"X-Linked-Etag": f'"{etag}"', "X-Linked-Size": str(len(content))}
        if head:
            return self._send(200, content, headers, head=True)
        asked = self.headers.get("Range")
        server.got.append((name, asked))
        if server.corrupt[name]:
            server.corrupt[name] -= 1
            content = bytes([content[0] ^ 1]) + content[1:]
        start = int(re.fullmatch(r"bytes=(\d+)-.*", asked)[1]) if asked else 0
        if start:
            headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
        cut = server.cut_once.pop(name, None)
        return self._send(206 if start else 200, content[start:], headers, cut=cut)

    def _entry(self, name, content):
        entry = {"type": "file", "path": name, "size": len(content), "oid": git_digest(content)}
        if name in self.server.large:
            digest = hashlib.sha256(content).hexdigest()
            entry["lfs"] = {"oid": digest, "size": len(content), "pointerSize": 130}
        return entry

    def _json(self, value):
        self._send(200, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def _send(self, status, body, headers=None, head=False, cut=None):
        self.send_response(status)
        for key, value in (headers or {}).items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if not head:
            self.wfile.write(body if cut is None else body[:cut])
        if cut is not None:
            self.close_connection = True
