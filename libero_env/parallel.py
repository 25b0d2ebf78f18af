"""Worker processes, and the progress of long work."""

import importlib
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import connection
from multiprocessing.context import SpawnContext
from types import TracebackType
from typing import Any, TypeVar

import cloudpickle

from libero_env.errors import ENDING_SIGNALS, LiberoError

T = TypeVar("T")
LONGEST_SILENCE = 4 * 3600.0  # [s] for one piece of work of a pool; the longest take minutes
_LOOK_SECONDS = 1.0  # between two looks at what workers have told
# [s] for the first picture of one of several processes; seconds where cores are shared
PICTURE_SECONDS = 120.0
NO_PICTURE = 76  # exit status of a worker that did not draw it in time
NO_PICTURE_TEXT = (
    "no first picture: in some drivers several processes that draw by EGL on one GPU hang for ever (mujoco#3444). Give "
    "--workers 1 (before a training: libero demos generate --workers 1), or set MUJOCO_GL=osmesa. What is finished is "
    "kept"
)


_tables: dict[str, dict[Any, Any]] = {}  # "module:name" of a table -> its entries that are not a user's


def send_to_workers(module: str, *names: str) -> None:
    """Have what users add to tables of a module, from now on, reach all processes that this package starts later."""
    for name in names:
        table = getattr(sys.modules[module], name)
        _tables[f"{module}:{name}"] = {k: dict(v) if isinstance(v, dict) else v for k, v in table.items()}


def user_entries() -> bytes:
    """Return what users have added to tables, for `add_entries` in another process; empty for nothing.

    Raises:
        LiberoError: An entry cannot be sent; the message names it.
    """
    changes: dict[str, tuple[dict[Any, Any], list[Any]]] = {}
    for address, own in _tables.items():
        table = _table(address)
        added = {
            key: value
            for key, value in table.items()
            if key not in own or not (own[key] is value or (isinstance(value, dict) and own[key] == value))
        }
        removed = [key for key in own if key not in table]
        if added or removed:
            changes[address] = added, removed
    if not changes:
        return b""
    try:
        return cloudpickle.dumps(changes)
    except Exception as whole:  # whatever the objects of a user raise
        for address, (added, _) in changes.items():
            for key, value in added.items():
                try:
                    cloudpickle.dumps(value)
                except Exception as error:
                    raise LiberoError(
                        f"{key!r}, which was added to {address.partition(':')[2]}, cannot be sent to a worker process "
                        f"({error}); define it without open files, locks or environments"
                    ) from error
        raise LiberoError(f"what was registered cannot be sent to a worker process ({whole})") from whole


def add_entries(content: bytes) -> None:
    """Add what `user_entries` has returned in the process that started this one."""
    for address, (added, removed) in (cloudpickle.loads(content) if content else {}).items():
        table = _table(address)
        for key in removed:
            table.pop(key, None)
        table.update(added)


def with_entries(content: bytes, function: Callable[..., T], *args: Any) -> T:
    """Call a function after `add_entries`."""
    add_entries(content)
    return function(*args)


def _table(address: str) -> dict[Any, Any]:
    module, _, name = address.partition(":")
    return getattr(importlib.import_module(module), name)


def spawn_context() -> SpawnContext:
    """Return the context of processes that start with a new interpreter: an OpenGL context that a fork inherits hangs.

    They are told the method of this process, and end where they do not know it, as that of joblib's processes.
    """
    if multiprocessing.get_start_method(True) not in (None, *multiprocessing.get_all_start_methods()):
        multiprocessing.set_start_method("spawn", force=True)
    return multiprocessing.get_context("spawn")


def spawn_pool(
    workers: int, *, picture_seconds: float = PICTURE_SECONDS, told: Any = None
) -> ProcessPoolExecutor:
    """Return a pool of processes that start with a new interpreter and end when this process ends.

    As a context manager, the pool is waited for after an error, and killed where the work is interrupted.

    Args:
        workers: Number of processes.
        picture_seconds: See `limit_first_picture`.
        told: Pipe that `tell_work` writes to.
    """
    arguments = user_entries(), picture_seconds, told
    return _Pool(workers, mp_context=spawn_context(), initializer=_start_worker, initargs=arguments)


@lru_cache
def after_forks(function: Callable[[], None]) -> None:
    """Call a function first in all processes that are forked from this one from now on."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=function)


def check_main_guard() -> None:
    """Check that this process is not a worker of `spawn_pool` that still imports the main script.

    Raises:
        LiberoError: It is: the script calls this without a guard, and its workers would wait for it, and it for them.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # as `multiprocessing.spawn` tells
        raise LiberoError(
            "worker processes import the script that was started, and it starts workers when it is imported: put what "
            'it does into a function, and call that below `if __name__ == "__main__":`'
        )


class _Pool(ProcessPoolExecutor):
    def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
        with _signals_later():  # it starts the processes, and one that is started in half prints a traceback
            return super().submit(*args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        processes = list((self._processes or {}).values())
        if kind is not None and issubclass(kind, KeyboardInterrupt | SilentWorkersError):
            for process in processes:  # Python 3.14 has kill_workers
                process.kill()
        self.shutdown(wait=True, cancel_futures=kind is not None)
        if kind is not None and issubclass(kind, BrokenExecutor):
            if any(process.exitcode == NO_PICTURE for process in processes):
                raise LiberoError(NO_PICTURE_TEXT) from error
            raise LiberoError(
                "a worker process ended, for the reason above or killed by the system if memory was short; what is "
                "finished is kept. The same command goes on; fewer workers need less memory"
            ) from error


@contextmanager
def _signals_later() -> Iterator[None]:
    """Heed the signals that ask this process to end after the block only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    numbers = [getattr(signal, name) for name in ENDING_SIGNALS if hasattr(signal, name)]
    before = {n: handler for n in numbers if callable(handler := signal.getsignal(n))}
    for number in before:
        signal.signal(number, lambda n, _: came.append(n))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


class SilentWorkersError(LiberoError):
    """Worker processes have finished nothing for so long that they hang."""


def as_finished(
    futures: Iterable[Future[T]],
    silence: float = LONGEST_SILENCE,
    on_wait: Callable[[], None] | None = None,
) -> Iterator[Future[T]]:
    """Yield futures of a pool as they are done; within `with spawn_pool(...)` its processes are ended after an error.

    Args:
        futures: Futures of one pool.
        silence: Largest time in which none is done, s.
        on_wait: Function that is called about every second and before each future that is done.

    Raises:
        SilentWorkersError: None was done for longer.
    """
    waiting, last = set(futures), time.monotonic()
    while waiting:
        timeout = silence if on_wait is None else min(silence, _LOOK_SECONDS)
        done, waiting = wait(waiting, timeout=timeout, return_when=FIRST_COMPLETED)
        if on_wait is not None:
            on_wait()
        if done:
            last = time.monotonic()
        elif time.monotonic() - last >= silence:
            raise SilentWorkersError(
                f"no worker process has finished anything for {silence / 3600:.1f} hours; they were ended, and what is "
                "finished is kept. The same command goes on; fewer workers need less memory and time"
            )
        yield from done


def run_each(
    function: Callable[..., T],
    arguments: Sequence[tuple[Any, ...]],
    workers: int,
    is_needed: Callable[[int], bool] = lambda _: True,
    on_work: Callable[[float, int], None] = lambda work, done: None,
) -> Generator[tuple[int, T], None, None]:
    """Call a function with each of several arguments, in this process or in a pool; yield position and result.

    Args:
        arguments: Arguments of each call.
        workers: Number of processes; 1 calls it in this process.
        is_needed: Whether the call of a position shall still begin; asked after each result.
        on_work: Function that gets what the calls pass to `tell_work`, in this process.
    """
    global _tell_work
    if workers < 2:
        _tell_work = on_work
        try:
            for i, one in enumerate(arguments):
                if is_needed(i):
                    yield i, function(*one)
        finally:
            _tell_work = None
        return
    heard, told = spawn_context().Pipe(
        duplex=False
    )  # without locks, which a killed process would leave behind

    def look() -> None:
        while heard.poll():
            on_work(*heard.recv())

    with heard, told, spawn_pool(workers, told=told) as pool:
        futures: dict[Future[T], int] = {pool.submit(function, *one): i for i, one in enumerate(arguments)}
        for future in as_finished(futures, on_wait=look):
            if not future.cancelled():
                yield futures[future], future.result()
                for other, i in futures.items():
                    if not is_needed(i):
                        other.cancel()


_tell_work: Callable[[float, int], None] | None = None


def tell_work(work: float, done: int = 0) -> None:
    """Tell who waits for the result of a call by `run_each` what is done of it since the last time.

    Args:
        work: Amount of work, in the unit of its progress.
        done: Number of pieces that are finished.
    """
    if _tell_work is not None:
        _tell_work(work, done)


def _start_worker(entries: bytes, picture_seconds: float, told: Any) -> None:
    for name in ("SIGINT", "SIGHUP"):  # a terminal sends them to all its processes; the parent ends this one
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    end_with_parent()
    limit_first_picture(picture_seconds)
    add_entries(entries)
    if told is not None:
        global _tell_work
        _tell_work = lambda work, done: told.send((work, done))  # noqa: E731 - few bytes, which pipes keep together


def end_with_parent() -> None:
    """End this process when its parent is gone; the workers of a killed process would otherwise wait forever."""
    parent, number = multiprocessing.parent_process(), os.getppid()

    def watch() -> None:
        while os.getppid() == number:
            if parent is None or parent.sentinel is None:  # as in the processes of joblib
                time.sleep(1.0)
            elif connection.wait([parent.sentinel], timeout=1.0):
                break
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


_picture_limit: tuple[float, bool] | None = None  # seconds, and whether this process tells that it gives up


def limit_first_picture(seconds: float | None = PICTURE_SECONDS, *, told_here: bool = False) -> None:
    """Have this process end where its first picture takes too long; called where other processes draw, too.

    Args:
        seconds: Largest time, [s]; None: no limit any more.
        told_here: Whether this process prints `NO_PICTURE_TEXT`; otherwise whoever sees its status `NO_PICTURE` does.
    """
    global _picture_limit
    _picture_limit = None if seconds is None else (seconds, told_here)


@contextmanager
def first_picture() -> Iterator[None]:
    """Draw within the limit of `limit_first_picture`, if there is one; the first picture ends it."""
    if _picture_limit is None:
        yield
        return
    timer = threading.Timer(_picture_limit[0], _give_up, _picture_limit[1:])
    timer.daemon = True
    timer.start()
    try:
        yield
        limit_first_picture(None)
    finally:
        timer.cancel()


def _give_up(told_here: bool) -> None:
    """End this process, whose drawing thread is in the driver and cannot be interrupted."""
    if told_here:
        sys.stdout.flush()
        print(f"error: {NO_PICTURE_TEXT}", file=sys.stderr, flush=True)
    os._exit(2 if told_here else NO_PICTURE)


def cpu_count() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def this_process() -> str:
    """Return the machine and number of this process, such as `node3:4711`."""
    return f"{socket.gethostname()}:{os.getpid()}"
