"""Claims on units of work in a folder that several processes share, on one machine or on several.

A claim is a file that only one process can create (`O_EXCL`, which NFS keeps since version 3). Its holder touches it
while it works. A claim is abandoned when it has not been touched for the length of a lease, or, at once, when its
holder ran on this machine and is gone. Times are those of the file server, so that clocks may differ; a claim that is
more than a lease in the future, as after that clock was set back, is abandoned too.

Claims save work, they do not guard results: two processes may both believe they hold a unit, for instance after one was
suspended. Whoever publishes a unit's result first wins (see `libero_eval.work.store`).
"""

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from libero_env.errors import InvalidInputError
from libero_env.parallel import is_running, process_start, this_machine
from libero_env.storage import regular_file
from libero_env.validation import validate

LEASE = 120.0  # s; network file systems may show a time of modification that is a minute old
BEATS = 8  # of a lease: how often a holder touches its claim
_MAX_BYTES = 1 << 16  # of a claim


@dataclass(frozen=True)
class Claim:
    """A claim on a unit.

    Attributes:
        host: Name of the machine of the holder.
        machine: Identity of the machine's process numbers: host, boot, and namespace (containers).
        pid: Process of the holder.
        process_start: When the process started, [s] after the boot; tells processes with the same number apart.
        token: Random text that tells claims apart.
    """

    unit: str
    host: str
    machine: str
    pid: Annotated[int, Field(ge=1, le=2**31 - 1)]
    process_start: float
    token: str


@dataclass(frozen=True)
class Held:
    """A claim as it was found in the folder.

    Attributes:
        claim: Its content; None if its holder has not written it, or was killed before it could.
        silent: Time since it was touched, [s].
        text: Content of the file.
    """

    unit: str
    claim: Claim | None
    silent: float
    text: bytes

    @property
    def holder(self) -> str:
        """The process as text, such as `node3:4711`."""
        return f"{self.claim.host}:{self.claim.pid}" if self.claim else "a process that is starting"

    def is_abandoned(self, lease: float) -> bool:
        """Return whether nobody works on the unit any more."""
        claim = self.claim
        gone = claim and claim.machine == this_machine() and not is_running(claim.pid, claim.process_start)
        return abs(self.silent) > lease or bool(gone)


class Claims:
    """The claims of a folder.

    Args:
        folder: Folder of the claims; it is created when a unit is claimed.
        lease: Time after which a claim that was not touched is abandoned, [s].
    """

    def __init__(self, folder: Path, lease: float = LEASE):
        self._folder, self._lease = folder, lease

    def take(self, unit: str) -> Claim | None:
        """Claim a unit, also one whose holder is gone; return None if another process holds it.

        Raises:
            OSError: The folder cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        if claim := self._create(unit):
            return claim
        held = self._read(unit, self._now())
        if held is not None and not (held.is_abandoned(self._lease) and self._remove(held)):
            return None
        return self._create(unit)

    def release(self, claim: Claim) -> None:
        """Give a unit back. Nothing happens if another process has taken the claim over."""
        held = self._read(claim.unit, 0.0)
        if held is not None and held.claim == claim:
            self._remove(held)

    @contextmanager
    def keeping(self, claim: Claim, on_beat: Callable[[], None] = lambda: None) -> Iterator[None]:
        """Touch a claim regularly while the block runs, and give it back at its end.

        Args:
            claim: Claim that this process holds.
            on_beat: Function that the touching thread calls each time.
        """
        stop = threading.Event()

        def beat() -> None:
            while not stop.wait(self._lease / BEATS):
                held = self._read(claim.unit, 0.0)
                if held is None or held.claim != claim:
                    return  # it was taken over
                with suppress(OSError):  # a file server that is away for a moment
                    os.utime(self._path(claim.unit))
                on_beat()

        thread = threading.Thread(target=beat, daemon=True, name=f"claim {claim.unit}")
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(self._lease)  # longer only where the file server hangs
            with suppress(OSError):
                self.release(claim)

    def held(self) -> dict[str, Held]:
        """Return the claims that are not abandoned, by unit."""
        paths = list(self._folder.glob("*.json"))
        now = self._now() if paths else 0.0
        claims = [self._read(path.stem, now) for path in paths]
        return {h.unit: h for h in claims if h is not None and not h.is_abandoned(self._lease)}

    def _path(self, unit: str) -> Path:
        return self._folder / f"{unit}.json"

    def _create(self, unit: str) -> Claim | None:
        pid = os.getpid()
        claim = Claim(unit, socket.gethostname(), this_machine(), pid, process_start(), secrets.token_hex(8))
        path = self._path(unit)
        try:
            file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            return None
        try:
            with open(file, "w", encoding="utf-8") as stream:
                json.dump(asdict(claim), stream)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        return claim

    def _read(self, unit: str, now: float) -> Held | None:
        """Return a claim, or None if there is none. Opening the file makes NFS ask the server for its times."""
        found = _text_of(self._path(unit))
        if found is None:
            return None
        try:
            claim = validate(Claim, json.loads(found[0]))
        except (InvalidInputError, ValueError, RecursionError):  # it is being written, or damaged
            claim = None
        return Held(unit, claim, now - found[1], found[0])

    def _remove(self, held: Held) -> bool:
        """Remove a claim, but not another that has taken its place; return whether it is gone."""
        path = self._path(held.unit)
        aside = path.with_name(f".{held.unit}.{secrets.token_hex(4)}.gone")
        try:
            os.rename(path, aside)  # of several processes one succeeds
        except FileNotFoundError:
            return True
        try:
            found = _text_of(aside)
            if found is None or found[0] == held.text:
                return True
            with suppress(OSError):
                os.link(aside, path)
            return False
        finally:
            aside.unlink(missing_ok=True)

    def _now(self) -> float:
        """Return the time of the file server: that of a file that is written now."""
        probe = self._folder / f".now.{secrets.token_hex(4)}"
        try:
            with open(probe, "wb") as stream:
                return os.fstat(stream.fileno()).st_mtime
        except OSError:  # nothing can be written: somebody looks at a folder of others
            return time.time()
        finally:
            with suppress(OSError):
                probe.unlink(missing_ok=True)


def _text_of(path: Path) -> tuple[bytes, float] | None:
    """Return the text of a claim, empty if it cannot be read, and when it was touched; None if there is none."""
    with suppress(FileNotFoundError):
        try:
            with open(path, "rb", opener=regular_file(_MAX_BYTES)) as stream:
                return stream.read(), os.fstat(stream.fileno()).st_mtime
        except FileNotFoundError:
            raise
        except OSError:
            return b"", path.lstat().st_mtime
    return None
