"""Chromium without a window: pages as a reader sees them, from disk, at any width, light or dark."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MAC = "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome"
PATIENCE = 60.0  # [s]
PHONE = 400  # [pixels]
OUTSIDE = """
(() => {
  const wide = (e) => e.scrollWidth > e.clientWidth && ["auto", "scroll"].includes(getComputedStyle(e).overflowX)
  const scrolls = (e) => e && (wide(e) || scrolls(e.parentElement))
  const shown = [...document.querySelectorAll("article *, body > main *")].filter((e) => e.checkVisibility())
    .filter((e) => e.textContent.trim() || e.matches("img, video, svg"))
  const outside = shown.filter((e) => e.getBoundingClientRect().right > innerWidth + 1 && !scrolls(e.parentElement))
  const small = shown.filter((e) => e.matches("svg text") && e.getBoundingClientRect().height < 8)
  return [...outside, ...small].map((e) => `${e.tagName} ${e.textContent.trim().slice(0, 40)}`)
})()
"""


class Browser:
    """A tab of a browser, driven over its debugging port."""

    def __init__(self, socket: ClientConnection):
        self.socket, self.number = socket, 0

    def call(self, method: str, **values: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": values}))
        while True:
            answer = json.loads(self.socket.recv(timeout=PATIENCE))
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """Return what an expression of JavaScript is in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str) -> Any:
        """Return an expression's value as soon as it is true; raise a TimeoutError after a minute."""
        end = time.monotonic() + PATIENCE
        while not (value := self.evaluate(expression)):
            if time.monotonic() > end:
                raise TimeoutError(expression)
            time.sleep(0.05)
        return value

    def open(self, page: Path, width: int = 1400, dark: bool = False) -> None:
        """Open a page from disk as wide as `width` pixels, with the system's preference for light or dark."""
        assert page.is_file(), page
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        size = {"width": width, "height": 900, "deviceScaleFactor": 1}
        self.call("Emulation.setDeviceMetricsOverride", **size, mobile=width < 600)
        self.call("Page.navigate", url="about:blank")
        self.until("location.href == 'about:blank'")
        self.call("Page.navigate", url=page.resolve().as_uri())
        self.until("location.protocol == 'file:' && document.readyState == 'complete'")

    def screenshot(self, out: Path, height: int | None = None) -> None:
        """Write a picture of the page from its top, as high as the page unless told."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": self.evaluate("innerWidth"), "height": height or size["height"]}
        picture = self.call(
            "Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip | {"scale": 1}
        )
        out.write_bytes(base64.b64decode(picture["data"]))

    def faults_on_a_phone(self, page: Path) -> list[str]:
        """Open a page as wide as a phone and return what cannot be read there: the page scrolls sideways, something
        is outside of it and of every box that scrolls, or text in a figure is tiny."""
        self.open(page, PHONE)
        wide = self.evaluate("document.documentElement.scrollWidth > innerWidth")
        return [f"{page.name} scrolls sideways"] * wide + self.evaluate(OUTSIDE)


def program() -> str:
    """Return the path of an installed browser; raise a FileNotFoundError if there is none."""
    found = next(filter(None, map(shutil.which, (*NAMES, MAC))), None)
    if found is None:
        raise FileNotFoundError(
            f"none of {', '.join(NAMES)} is installed; on Debian: apt-get install chromium"
        )
    return found


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Start a browser whose profile is in a folder, and end it."""
    words = [program(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    words += ["--no-first-run", f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank"]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            port = _port(folder / "DevToolsActivePort", process)
            with connect(f"ws://127.0.0.1:{port}/devtools/page/{_tab(port)}", max_size=None) as socket:
                yield Browser(socket)
        finally:
            process.terminate()


def _port(file: Path, process: subprocess.Popen[bytes]) -> int:
    """Wait until the browser has written its port into a file of its profile."""
    end = time.monotonic() + PATIENCE
    while not (file.exists() and file.read_text()):
        assert process.poll() is None, f"the browser ended with status {process.returncode}"
        assert time.monotonic() < end, "the browser does not start"
        time.sleep(0.05)
    return int(file.read_text().split()[0])


def _tab(port: int) -> str:
    """Return the id of the tab that is open."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=PATIENCE) as answer:
        return next(target["id"] for target in json.load(answer) if target["type"] == "page")
