"""Further processes on this machine that work on the same evaluation."""

import multiprocessing
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any

from libero_env.parallel import end_with_parent

MOST_DEATHS = 3  # killed processes that are replaced without a unit being finished in between
PATIENCE = 30.0  # s; for processes to end by themselves


class Crew:
    """Processes that call a function of a module; they end with this process. One that is killed is replaced.

    Args:
        count: Number of processes.
        function: Function that each of them calls.
        argument: Argument of the function; it is pickled.
    """

    def __init__(self, count: int, function: Callable[[Any], None], argument: Any):
        self._count, self._function, self._argument = count, function, argument
        self._context = multiprocessing.get_context("spawn")  # an OpenGL context that a fork inherits hangs
        self._processes: list[BaseProcess] = []
        self._deaths, self._done = 0, 0

    @property
    def pids(self) -> list[int]:
        """Numbers of the processes that run."""
        return [process.pid for process in self._processes if process.is_alive() and process.pid]

    def tend(self, done: int) -> None:
        """Replace processes that were killed.

        Args:
            done: Number of units that are done. Where it does not grow, the processes are killed by what they run.
        """
        if done > self._done:
            self._deaths, self._done = 0, done
        for i, process in enumerate(self._processes):
            if process.exitcode is None or process.exitcode >= 0:
                continue
            self._deaths += 1
            more = self._deaths <= MOST_DEATHS
            what = "another is started" if more else "no other is started"
            print(f"process {process.pid} was killed (signal {-process.exitcode}); {what}", file=sys.stderr)
            if more:
                self._processes[i] = self._start()
            else:
                del self._processes[i]
                return

    def __enter__(self) -> "Crew":
        self._processes = [self._start() for _ in range(self._count)]
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        for process in self._processes:
            if kind is None:
                process.join(PATIENCE)
            process.terminate()
        end = time.monotonic() + PATIENCE
        for process in self._processes:
            process.join(max(0.0, end - time.monotonic()))
            process.kill()
            process.join(PATIENCE)

    def _start(self) -> BaseProcess:
        process = self._context.Process(target=_call, args=(self._function, self._argument))
        process.start()
        return process


def _call(function: Callable[[Any], None], argument: Any) -> None:
    end_with_parent()
    function(argument)
