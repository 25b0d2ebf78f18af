"""Claims on units of work in a folder that several processes share, on one machine or on several.

A claim is a file that its holder has locked. The system gives the lock back when the process ends, however it ends; a
folder on a network must keep locks between machines, as that of a run must, or else units are worked on twice.

Claims save work, they do not guard results: whoever publishes a unit's result first wins (`libero_eval.work.store`).
"""

from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from libero_env.parallel import this_process
from libero_env.storage import atomic_write_text, regular_file, system_lock
from libero_env.text import printable


class Claims:
    """The claims of a folder.

    Args:
        folder: Folder of the claims; it is created when a unit is claimed.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._own: dict[str, FileLock] = {}  # of this process; on some file systems it could lock them again

    def take(self, unit: str) -> bool:
        """Claim a unit, also one whose holder is gone; return whether no other process holds it.

        Raises:
            OSError: The folder cannot be written, or its files cannot be locked.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        if unit in self._own or (lock := self._locked(unit)) is None:
            return False
        self._own[unit] = lock
        atomic_write_text(self._holder(unit), this_process())
        return True

    def release(self, unit: str) -> None:
        """Give a unit back."""
        self._unlock(unit, self._own.pop(unit))

    def held(self) -> dict[str, str]:
        """Return the units that processes work on, and by which process, such as `node3:4711`."""
        found = {}
        for path in self._folder.glob("*.lock"):
            if path.stem not in self._own:
                try:
                    lock = self._locked(path.stem)
                except OSError:  # nothing can be written: somebody looks at a folder of others
                    continue
                if lock is not None:  # the holder is gone, or gave it back a moment ago
                    self._unlock(path.stem, lock)
                    continue
            found[path.stem] = "a process that is starting"
            with suppress(OSError), open(self._holder(path.stem), "rb", opener=regular_file(1000)) as file:
                found[path.stem] = printable(file.read().decode(errors="replace"))
        return found

    def _locked(self, unit: str) -> FileLock | None:
        """Return a lock of a unit's file; None if another process holds it."""
        try:
            return system_lock(self._folder / f"{unit}.lock")
        except Timeout:
            return None

    def _unlock(self, unit: str, lock: FileLock) -> None:
        with suppress(OSError):  # a file server that is away for a moment
            self._holder(unit).unlink(missing_ok=True)
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()

    def _holder(self, unit: str) -> Path:
        return self._folder / f"{unit}.txt"
