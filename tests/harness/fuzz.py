"""Property tests of what comes from outside: anything may be refused, nothing may surprise.

A test of `tests/fuzz` draws inputs of one surface and passes each to `survive`. In the test suite it is short and
always draws the same; `make fuzz` sets `LIBERO_FUZZ` and draws thousands, counted by surface in the folder it names.
"""

import json
import os
import resource
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, settings

from libero_env.errors import LiberoError

FOLDER = os.environ.get("LIBERO_FUZZ")  # where a long run counts; None in the test suite
SEED = int(os.environ.get("LIBERO_FUZZ_SEED", "0"))
SECONDS = 20.0  # an input that computes for longer is a fault
WALL_SECONDS = 180.0  # likewise one that waits for longer; machines have other things to do
MEMORY = 4 << 30  # [bytes] likewise one that asks for more than this, beyond what the process has

_counts: dict[str, Counter[str]] = {}


class _OvertimeError(BaseException):
    """An input takes too long; no handler of the code under test takes it for an error of its own."""


class SurprisingError(AssertionError):
    """An input raised an error that is not one of ours, hung, or asked for too much memory."""


def examples(short: int, long: int) -> settings:
    """Return hypothesis's settings of a test by its numbers of inputs, in the test suite and for `make fuzz`."""
    return settings(
        max_examples=long if FOLDER else short,
        derandomize=SEED == 0,
        database=None,
        deadline=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )


def survive(surface: str, attempt: Callable[[], Any], *, allowed: tuple[type[Exception], ...] = ()) -> Any:
    """Return what a function gives for a hostile input; None where it refuses it by an error that is ours or allowed.

    Raises:
        SurprisingError: The function raised another error, took too long or asked for too much memory.
    """
    counts = _counts.setdefault(surface, Counter())
    counts["tried"] += 1
    try:
        with _limits():
            found = attempt()
        counts["accepted"] += 1
        return found
    except (LiberoError, *allowed) as error:
        assert str(error).strip(), "an error says what is wrong"
        counts["refused"] += 1
        return None
    except (Exception, _OvertimeError) as error:
        counts["faults"] += 1
        raise SurprisingError(f"{surface}: {type(error).__name__}: {error}") from error
    finally:
        _save()


@contextmanager
def _limits() -> Iterator[None]:
    """Limit time and memory within the context."""

    def end(number: int, frame: object) -> None:
        raise _OvertimeError("computed or waited for too long")

    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    wall = (signal.SIGALRM, signal.ITIMER_REAL, WALL_SECONDS)
    timers = (wall, (signal.SIGPROF, signal.ITIMER_PROF, SECONDS))
    before = {number: signal.signal(number, end) for number, _, _ in timers}
    for _, timer, seconds in timers:
        signal.setitimer(timer, seconds)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for number, timer, _ in timers:
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


def _save() -> None:
    if FOLDER is None:
        return
    worker = os.environ.get("PYTEST_XDIST_WORKER", "main")
    content = {surface: dict(counts) for surface, counts in _counts.items()}
    Path(FOLDER, f"{worker}-{os.getpid()}.json").write_text(json.dumps(content))
