"""Processes of an evaluation: each takes units from the folder until all are done, and writes the result."""

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.process import BaseProcess
from typing import Any

from libero_env.errors import LiberoError, RenderError
from libero_env.parallel import (
    NO_PICTURE,
    NO_PICTURE_TEXT,
    PICTURE_SECONDS,
    end_with_parent,
    limit_first_picture,
    spawn_context,
    user_entries,
    with_entries,
)
from libero_env.text import printable
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult, TaskResult
from libero_eval.work.evaluation import Evaluation
from libero_eval.work.progress import Batch, Progress, measure_progress
from libero_eval.work.store import Unit, UnitErrors, UnitResult, describe
from lifelong.errors import ConnectionLost, EvaluationIncompleteError

POLL = 0.5  # s between two looks at the folder while other processes work on the last units
SAY_EVERY = 30.0  # s between two lines of progress
FAILURES_IN_A_ROW = 3  # of units, which end a process
_MOST_DEATHS = 3  # killed processes that are replaced without a unit being finished in between
_PATIENCE = 30.0  # s; for processes to end by themselves


class Worker:
    """A process of an evaluation.

    Args:
        evaluation: What is evaluated.
        on_result: Function called with each task's result as soon as it is known, whoever ran it.
        on_progress: Function called with the progress of all processes every half minute, and at the end.
        on_error: Function called with a text when a unit ends with an error.
        on_wait: Function called between units, and regularly while there are none, with the number of units done.
    """

    def __init__(
        self,
        evaluation: Evaluation,
        *,
        on_result: Callable[[TaskResult], None] = lambda _: None,
        on_progress: Callable[[Progress], None] = lambda _: None,
        on_error: Callable[[str], None] = lambda text: print(printable(text), file=sys.stderr, flush=True),
        on_wait: Callable[[int], None] = lambda _: None,
    ):
        self._evaluation, self._store = evaluation, evaluation.store
        self._on_result, self._on_progress = on_result, on_progress
        self._on_error, self._on_wait = on_error, on_wait
        self._names = {unit.name for unit in evaluation.units}
        self._attempts_before: dict[str, int] = {}
        self._announced: set[str] = set()
        self._succeeded, self._in_a_row, self._said = False, 0, -math.inf
        self._task: str | None = None
        self._batch: Batch | None = None  # that this process runs, or ran last

    def run(self, *, wait: bool = True) -> EvaluationResult | None:
        """Evaluate units; write `eval.json` and return its content if all are done.

        Args:
            wait: Whether to wait for units that others work on; otherwise None is returned where no other is left.

        Raises:
            ConfigError: The folder holds another evaluation.
            EvaluationIncompleteError: Units ended with errors, and there is nothing else to do.
        """
        evaluation, store = self._evaluation, self._store
        store.join(evaluation.units)
        self._attempts_before = {name: errors.attempts for name, errors in store.errors().items()}
        if done := self._look():  # somebody has begun
            self._say(done)
        with evaluation.pool() as self._pool:
            while evaluation.starts_needed(done := self._look()) is None:
                self._on_wait(len(done))
                errors, held = self._errors(), set(store.claims.held())
                choice = self._order(done, errors, held)
                if unit := store.take(choice):
                    self._work(unit)
                elif not wait:
                    return None
                elif choice or held & self._names:
                    self._say(done)
                    time.sleep(POLL)
                elif len(store.done(evaluation.units)) == len(done):
                    raise self._incomplete(errors)
        result = evaluation.result(done)
        if store.is_whole(evaluation.units):
            result.write(evaluation.out / FILE_NAME)
        return result

    def _errors(self) -> dict[str, UnitErrors]:
        """Return the errors of the units that are not done; the folder may have those of others."""
        return {name: errors for name, errors in self._store.errors().items() if name in self._names}

    def _look(self) -> Mapping[str, UnitResult]:
        """Return the units that are done; announce the tasks that are complete."""
        done = self._store.done(self._evaluation.units)
        for task in self._evaluation.tasks:
            if task.id not in self._announced and (result := self._evaluation.task_result(task, done)):
                self._announced.add(task.id)
                self._on_result(result)
        return done

    def _order(
        self, done: Mapping[str, UnitResult], errors: Mapping[str, UnitErrors], held: set[str]
    ) -> list[Unit]:
        """Return the units to choose from, best first: the open task's, then those of a task nobody works on."""
        open_units = [u for u in self._evaluation.units if u.name not in done and u.name not in held]
        left = [unit for unit in open_units if self._tries(unit, errors) <= self._evaluation.retries]
        busy = {unit.task.id for unit in self._evaluation.units if unit.name in held}
        counts = Counter(unit.task.id for unit in left)

        def preference(unit: Unit) -> tuple:
            task = unit.task.id
            tried, others = self._tries(unit, errors) > 0, task in busy
            return (
                tried,
                self._evaluation.turn(unit),
                task != self._task,
                others,
                -counts[task] if others else 0,
            )

        return sorted(left, key=preference)

    def _tries(self, unit: Unit, errors: Mapping[str, UnitErrors]) -> int:
        attempts = errors[unit.name].attempts if unit.name in errors else 0
        return max(0, attempts - self._attempts_before.get(unit.name, 0))

    def _work(self, unit: Unit) -> None:
        self._task, first = unit.task.id, None

        def note(steps: int, most: int) -> None:
            nonlocal first
            now = time.monotonic()
            first = first or (steps, now)  # what compiles before does not count
            self._batch = Batch(unit.name, steps, most, steps - first[0], now - first[1])
            if now - self._said > SAY_EVERY:
                with suppress(LiberoError, OSError):  # the loop reports what is wrong
                    self._say(self._store.done(self._evaluation.units))

        try:
            done = self._store.done(self._evaluation.units)
            label = f"{self._progress(done)} | {unit.task.id}" if self._evaluation.progress else ""
            try:
                result: UnitResult | None = self._evaluation.evaluate(unit, self._pool, label, note)
            except Exception as error:  # noqa: BLE001 - policies raise errors of any type
                self._pool.close()
                result = self._after_error(unit, error)
            if result is not None:
                self._store.publish(unit, result)
                self._succeeded, self._in_a_row = True, 0
        finally:
            self._store.claims.release(unit.name)
        self._say(self._store.done(self._evaluation.units))

    def _after_error(self, unit: Unit, error: Exception) -> UnitResult | None:
        """Record an error; return a result if the protocol counts it; raise it if going on makes no sense."""
        if isinstance(error, RenderError):  # of this machine
            raise error
        if isinstance(error, OSError) and str(self._evaluation.out) in str(error.filename or ""):
            raise error
        errors = self._store.add_error(unit, error)
        tries = self._tries(unit, {unit.name: errors})
        self._on_error(
            f"{unit.name}: attempt {tries} ended with {describe(error)}; traceback in {errors.path}"
        )
        if self._evaluation.errors_are_failures and not isinstance(error, LiberoError):
            if tries <= self._evaluation.retries:
                return None
            return self._evaluation.evaluate_apart(unit, self._pool, has_worked=self._store.has_results)
        self._in_a_row += 1
        never_worked = not self._succeeded and not self._store.has_results
        if isinstance(error, ConnectionLost) and tries <= self._evaluation.retries:
            return None
        if never_worked or self._in_a_row >= FAILURES_IN_A_ROW:
            raise error
        return None

    def _incomplete(self, errors: Mapping[str, UnitErrors]) -> EvaluationIncompleteError:
        shown = "; ".join(f"{name}: {error.last}" for name, error in list(errors.items())[:3])
        more = f"; and {len(errors) - 3} more" if len(errors) > 3 else ""
        return EvaluationIncompleteError(
            f"{len(errors)} of {len(self._evaluation.units)} units ended with errors and are not counted "
            f"({shown}{more}). Tracebacks are in {self._evaluation.out / 'errors'}; "
            "the same command tries these units again"
        )

    def _say(self, done: Mapping[str, UnitResult]) -> None:
        """Report the progress, but not too often; always when everything is done."""
        now = time.monotonic()
        if now - self._said > SAY_EVERY or len(done) == len(self._evaluation.units):
            self._said = now
            self._on_progress(self._progress(done))

    def _progress(self, done: Mapping[str, UnitResult]) -> Progress:
        running, failed = len(self._names & self._store.claims.held().keys()), len(self._errors())
        sizes = {unit.name: len(unit.init_states) for unit in self._evaluation.units}
        return measure_progress(sizes, done, running, failed, self._batch)


class Workers:
    """Processes that call a function of a module; they end with this process. One that is killed is replaced.

    Args:
        count: Number of processes.
        function: Function that each of them calls.
        argument: Argument of the function; it is pickled.
        picture_seconds: See `libero_env.parallel.limit_first_picture`.
    """

    def __init__(
        self,
        count: int,
        function: Callable[[Any], None],
        argument: Any,
        picture_seconds: float = PICTURE_SECONDS,
    ):
        self._count, self._function, self._argument = count, function, argument
        self._picture_seconds = picture_seconds
        self._context = spawn_context()
        self._processes: list[BaseProcess] = []
        self._deaths, self._done = 0, 0

    @property
    def pids(self) -> list[int]:
        """Numbers of the processes that run."""
        return [process.pid for process in self._processes if process.is_alive() and process.pid]

    def supervise(self, done: int) -> None:
        """Replace processes that were killed.

        Args:
            done: Number of units that are done. Where it does not grow, the processes are killed by what they run.

        Raises:
            LiberoError: One has hung in its first picture.
        """
        if any(process.exitcode == NO_PICTURE for process in self._processes):
            raise LiberoError(NO_PICTURE_TEXT)
        if done > self._done:
            self._deaths, self._done = 0, done
        for i, process in enumerate(self._processes):
            if process.exitcode is None or process.exitcode >= 0:
                continue
            self._deaths += 1
            more = self._deaths <= _MOST_DEATHS
            what = "another is started" if more else "no other is started"
            print(f"process {process.pid} was killed (signal {-process.exitcode}); {what}", file=sys.stderr)
            if more:
                self._processes[i] = self._start()
            else:
                del self._processes[i]
                return

    def __enter__(self) -> "Workers":
        if self._count:
            limit_first_picture(self._picture_seconds, told_here=True)
        self._processes = [self._start() for _ in range(self._count)]
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        limit_first_picture(None)
        for process in self._processes:
            if kind is None:
                process.join(_PATIENCE)
            process.terminate()
        end = time.monotonic() + _PATIENCE
        for process in self._processes:
            process.join(max(0.0, end - time.monotonic()))
            process.kill()
            process.join(_PATIENCE)

    def _start(self) -> BaseProcess:
        arguments = (self._picture_seconds, user_entries(), self._function, self._argument)
        process = self._context.Process(target=_call, args=arguments)
        process.start()
        return process


def _call(picture_seconds: float, entries: bytes, function: Callable[[Any], None], argument: Any) -> None:
    end_with_parent()
    limit_first_picture(picture_seconds)
    with_entries(entries, function, argument)
