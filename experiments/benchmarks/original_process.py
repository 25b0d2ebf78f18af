"""The original benchmark in a process of its own, under its own interpreter."""

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

WORKER = Path(__file__).with_name("original_worker.py")


class Original:
    """Asks `original_worker.py` one thing after the other.

    Args:
        python: the original's interpreter.
        config: its `LIBERO_CONFIG_PATH`.
    """

    def __init__(self, python: str, config: Path):
        env = {**os.environ, "LIBERO_CONFIG_PATH": str(config), "OMP_NUM_THREADS": "1"}
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 - as long as the process
        self._process = subprocess.Popen(
            [python, "-W", "ignore", WORKER],
            env=env,
            text=True,
            bufsize=1,
            stderr=self._log,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self.pid = self._process.pid

    def __call__(self, do: str, **arguments: Any) -> dict[str, Any]:
        """Ask for one thing and wait for it; `original_worker.py` has the functions.

        Raises:
            SystemExit: it stopped; the message ends with what it said.
        """
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
        if not (line := self._process.stdout.readline()):
            self._log.seek(0)
            raise SystemExit(f"the original stopped at {do!r}:\n{self._log.read()[-2000:]}")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
        self._log.close()


@contextmanager
def one_core(*processes: int) -> Iterator[None]:
    """Pin this thread and the main threads of other processes to one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    for pid in (0, *processes):
        os.sched_setaffinity(pid, {max(before)})
    try:
        yield
    finally:
        for pid in (0, *processes):
            os.sched_setaffinity(pid, before)
