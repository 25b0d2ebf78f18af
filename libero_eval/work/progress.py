"""How far an evaluation is that several processes share, and its results as lines of a table."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from libero_env.progress import estimated_total
from libero_env.published import parse_plus_id
from libero_env.text import duration, shorten
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult, TaskResult
from libero_eval.protocols.naming import protocol_label
from libero_eval.work.store import UnitResult, WorkStore, read_plan, read_unit
from lifelong.results.failures import causes_text, safety_text
from lifelong.stats.intervals import Estimate

PLUS = "libero_plus_"  # beginning of the names of suites of LIBERO-Plus
RECENT = 50  # units from which the speed is taken


@dataclass(frozen=True)
class Batch:
    """How far the episodes of a unit are, which run together.

    Attributes:
        steps: Control steps of all episodes so far.
        most: Largest number that they can become.
        timed: Number of them that have been timed.
        seconds: Time that these took.
    """

    unit: str
    steps: int
    most: int
    timed: int
    seconds: float

    @property
    def expected(self) -> float:
        """Seconds that all steps take, within a factor of two; NaN where that is not known yet."""
        known = self.timed and self.seconds >= 1.0
        return estimated_total(self.steps, self.most) * self.seconds / self.timed if known else math.nan


@dataclass(frozen=True)
class Progress:
    """How far an evaluation is, all processes together.

    Attributes:
        running: Number of units that processes work on.
        failed: Number of units that are not done and ended with an error.
        per_hour: Episodes per hour of the recent units, over the time in which any process ran one; at first what the
            running batch lets expect, NaN before that.
        steps: Control steps of the batch that this process runs.
        ahead: Episodes that this batch and those of other processes have done by now, if they are as far.
    """

    units: int
    done: int
    episodes: int
    episodes_done: int
    running: int
    failed: int
    per_hour: float
    steps: int = 0
    ahead: float = 0.0

    @property
    def seconds_left(self) -> float:
        """Time until the end at this speed, [s]; NaN if the speed is not known."""
        left = max(self.episodes - self.episodes_done - self.ahead, 0.0)
        return 3600 * left / self.per_hour if self.per_hour else math.nan

    def __str__(self) -> str:
        """Return one line, such as `12 of 50 units, 120 of 500 episodes, 1,830 an hour, 12 min left, 3 running`."""
        parts = [f"{self.done} of {self.units} units", f"{self.episodes_done} of {self.episodes} episodes"]
        parts += [f"{self.steps:,} control steps of the next"] if self.steps else []
        if math.isfinite(self.per_hour):
            parts += [f"{self.per_hour:,.0f} an hour"]
            parts += [f"{duration(self.seconds_left)} left"] if self.done < self.units else []
        parts += [f"{self.running} running"] if self.running else []
        parts += [f"{self.failed} with errors"] if self.failed else []
        return ", ".join(parts)


def measure_progress(
    units: Mapping[str, int],
    done: Mapping[str, UnitResult],
    running: int = 0,
    failed: int = 0,
    batch: Batch | None = None,
) -> Progress:
    """Return the progress of an evaluation.

    Args:
        units: Number of episodes of each unit, by its name.
        running: Number of units that processes work on.
        failed: Number of units with errors.
        batch: The batch that this process runs, or ran last.
    """
    recent = sorted(done.values(), key=lambda unit: unit.finished)[-RECENT:]
    busy = busy_seconds((unit.started, unit.finished) for unit in recent)
    count = sum(len(unit.result.starts) for unit in recent)
    per_hour = 3600 * count / busy if busy else math.nan
    runs = batch is not None and batch.unit not in done
    ahead = 0.0
    if batch is not None and math.isfinite(seconds := batch.expected):
        together = max(running, 1) * units[batch.unit]
        if len(done) <= max(running, 1):  # the time of the first units has what was compiled in it
            per_hour = 3600 * together / seconds
        ahead = together * min(batch.steps / estimated_total(batch.steps, batch.most), 1.0) if runs else 0.0
    return Progress(
        units=len(units),
        done=sum(name in done for name in units),
        episodes=sum(units.values()),
        episodes_done=sum(count for name, count in units.items() if name in done),
        running=running,
        failed=failed,
        per_hour=per_hour,
        steps=batch.steps if batch is not None and runs else 0,
        ahead=ahead,
    )


def busy_seconds(spans: Iterable[tuple[float, float]]) -> float:
    """Return the length of the union of time spans (start, end), [s]: interruptions do not count."""
    total, until = 0.0, -math.inf
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total


def describe_status(path: Path) -> tuple[str, Progress]:
    """Return how far an evaluation is, as text with who works on which unit and what went wrong, and as numbers.

    Args:
        path: Folder of the evaluation.

    Raises:
        LifelongError: The folder holds no evaluation, or a broken file.
    """
    plan = read_plan(path)
    store, units = WorkStore(path, plan), plan["units"]
    files = {name: path / "units" / f"{name}.json" for name in units}
    done = {name: read_unit(file)[0] for name, file in files.items() if file.exists()}
    held = {name: one for name, one in store.claims.held().items() if name in units}
    errors = {name: one for name, one in store.errors().items() if name in units}
    progress = measure_progress(units, done, len(held), len(errors))
    lines = [
        f"policy    {', '.join(f'{k} {shorten(str(v))}' for k, v in plan['evaluated'].items())}",
        f"progress  {progress}",
    ]
    lines += [f"running   {name} by {holder}" for name, holder in sorted(held.items())]
    for name, error in errors.items():
        lines.append(f"error     {name}, {error.attempts} attempts: {error.last}; see {error.path}")
    if len(done) == len(units):
        lines.append(f"result    {path / FILE_NAME}")
    elif not held and (path / FILE_NAME).is_file() and EvaluationResult.read(path).stopped:
        lines.append(f"result    {path / FILE_NAME}, stopped early; the command goes on without --until")
    elif not held:
        lines.append("stopped   no process works on it; the same command goes on")
    return "\n".join(lines), progress


HEADER = f"{'task':<18} {'successes':>9} {'%':>6} {'95 %':>13} {'steps':>6}  instruction"


def table_row(result: TaskResult, success: Estimate | None = None) -> str:
    """Format a task's row under `HEADER`: successes, rate and interval in percent, mean steps of the successes.

    Args:
        success: Its success; by default with Wilson's interval.
    """
    wins = f"{sum(result.successes)}/{len(result.successes)}"
    steps = f"{result.steps:.0f}" if math.isfinite(result.steps) else "-"
    raised = sum(error is not None for error in result.errors)
    notes = [f"{raised} ended with an error"] if raised else []
    notes += filter(None, (result.error_note, result.event_note, result.clock_note))
    text = "".join(f"  ({note})" for note in notes)
    return f"{result.task:<18} {wins:>9} {_percent(success or result.success)} {steps:>6}  {result.instruction}{text}"


def total_rows(result: EvaluationResult) -> list[str]:
    """Format the rows of each suite and of each kind of LIBERO-Plus, where there are several, and of all together."""
    results = result.tasks
    kinds: dict[str, list[TaskResult]] = {}
    for task in results:
        if task.suite.startswith(PLUS):
            kinds.setdefault(f"  {parse_plus_id(task.name).kind}", []).append(task)
    suites, labels = result.by_suite, result.suite_labels
    rows = {**(suites if len(suites) > 1 else {}), **(kinds if len(kinds) > 1 else {})}
    parts = [label for suite, label in labels.items() if label != suite and len(suites) == 1]
    width = max(18, *(len(labels.get(name, name)) for name in rows), 0)
    lines = []
    for name, tasks in {**rows, "mean over tasks": results}.items():
        wins, episodes = sum(sum(r.successes) for r in tasks), sum(len(r.successes) for r in tasks)
        failed = sum(len(r.simulation_errors) for r in tasks)
        note = (
            f"  ({failed} of {episodes + failed} ended by a simulation error, not counted)" if failed else ""
        )
        if tasks is results:
            note += f"  {', '.join(parts)}" if parts else ""
            note += f"  ({result.stop_note})" if result.stopped else ""
        lines.append(
            f"{labels.get(name, name):<{width}} {f'{wins}/{episodes}':>9} {_percent(result.success_of(tasks))}{note}"
        )
    label = protocol_label(result.protocol, suites)
    lines += [f"{'protocol':<18} {label}"] if label != result.protocol.get("name") else []
    found = {"failed because": causes_text(results), "costs": safety_text(results)}
    return [*lines, *(f"{name:<18} {text}" for name, text in found.items() if text)]


def _percent(e: Estimate) -> str:
    interval = f"[{100 * e.low:.1f}, {100 * e.high:.1f}]" if math.isfinite(e.low) else "-"
    return f"{100 * e.value:6.1f} {interval:>13}"
