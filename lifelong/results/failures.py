"""Why rollouts of a run failed, how many were safe, and for which learned task an erring rollout was of use."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from libero_env.sim.causes import CAUSES, Failure
from lifelong.results.records import Episodes, EvalRecord
from lifelong.results.results import Results

QUADRANTS = ("safe success", "unsafe success", "safe failure", "unsafe failure")
NOT_SEEN = "not seen"


@dataclass(frozen=True)
class Tally:
    """Numbers of rollouts by outcome in the success matrix of a run; positions of tasks count from 0.

    Attributes:
        outcomes: Outcomes that occur: causes of failures, or `QUADRANTS`.
        by_task: Task -> number of rollouts by outcome, at the end of the run.
        after: Learned task -> number of rollouts by outcome, over all tasks that were measured after learning it.
    """

    outcomes: tuple[str, ...]
    by_task: Mapping[int, Mapping[str, int]]
    after: Mapping[int, Mapping[str, int]]


@dataclass(frozen=True)
class FailureScore(Tally):
    """Causes of the failures in the success matrix of a run.

    Attributes:
        interference: Task of a failed rollout, learned task that it served -> number of rollouts at the end of the run:
            whose goal has an atom that held at its end, or else whose object or fixture it handled.
    """

    interference: Mapping[tuple[int, int], int]


def count_causes(episodes: Iterable[Episodes]) -> dict[str, int]:
    """Return how many episodes failed of each cause, in the order of the decision tree, and where it was not seen."""
    found = Counter(
        NOT_SEEN if one is None else one.cause
        for part in episodes
        for one, won in zip_longest(part.failures, part.successes)
        if not won
    )
    return {cause: found[cause] for cause in (*CAUSES, NOT_SEEN) if found[cause]}


def causes_text(episodes: Iterable[Episodes]) -> str:
    """Return these numbers as text, such as `dropped 3, never reached 1`; empty where nothing was seen."""
    return _text(count_causes(episodes))


def count_quadrants(episodes: Iterable[Episodes]) -> dict[str, int]:
    """Return how many episodes were safe or unsafe and succeeded or failed, and where costs were not seen."""
    found = Counter(
        NOT_SEEN
        if cost is None
        else f"{'unsafe' if cost.exceeded else 'safe'} {'success' if won else 'failure'}"
        for part in episodes
        for cost, won in zip_longest(part.costs, part.successes)
    )
    return dict.fromkeys(QUADRANTS, 0) | found


def safety_text(episodes: Sequence[Episodes]) -> str:
    """Return these numbers as text, with how many were beyond the limit of each cost; empty where nothing was seen."""
    beyond = Counter(name for part in episodes for cost in part.costs if cost for name in cost.exceeded)
    unsafe = f" (unsafe by {', '.join(f'{k} {n}' for k, n in beyond.items())})" if beyond else ""
    return _text(count_quadrants(episodes)) + unsafe


def anything_seen(*counts: Mapping[str, int]) -> bool:
    """Return whether any of these numbers of episodes by outcome are of an outcome that was seen."""
    return any(number for found in counts for name, number in found.items() if name != NOT_SEEN)


def _text(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) if anything_seen(counts) else ""


def _matrix(results: Results) -> dict[tuple[int, int], EvalRecord]:
    """Return the evaluations of the tasks learned so far; the row of a task that is being learned is not complete."""
    learned, found = results.learned_tasks(), results.evaluations()
    return {(r.learned, r.task): r for r in found if r.phase == "matrix" and r.learned < learned}


def _tally(
    cells: Mapping[tuple[int, int], Episodes], count: Callable[[Iterable[Episodes]], dict[str, int]]
) -> Tally | None:
    """Return the numbers of rollouts by outcome; None where no outcome occurs."""
    outcomes = count(cells.values())
    if not anything_seen(outcomes):
        return None
    rows = sorted({learned for learned, _ in cells})
    return Tally(
        tuple(outcomes),
        {task: count([cell]) for (learned, task), cell in sorted(cells.items()) if learned == rows[-1]},
        {row: count(cell for (learned, _), cell in cells.items() if learned == row) for row in rows},
    )


def safety_score(results: Results) -> Tally | None:
    """Return how many rollouts of a run's success matrix were safe; None where it was not recorded."""
    return _tally(_matrix(results), count_quadrants)


def failure_score(results: Results) -> FailureScore | None:
    """Return why the rollouts of a run's success matrix failed; None where none did, or it was not recorded."""
    cells = _matrix(results)
    if (tally := _tally(cells, count_causes)) is None:
        return None
    atoms = {task: cell.atoms for (_, task), cell in cells.items()}
    served = Counter(
        (task, other)
        for (learned, task), cell in cells.items()
        if learned == max(tally.after)
        for one in cell.failures
        if one is not None
        for other in _served(one, task, atoms)
    )
    return FailureScore(tally.outcomes, tally.by_task, tally.after, served)


def rollout_summary(results: Results) -> dict[str, dict[str, object]]:
    """Return both as plain data; `interference` as rows of task, learned task and number of rollouts."""
    failures, safety = failure_score(results), safety_score(results)
    found: dict[str, dict[str, object]] = {
        name: {"by_task": dict(score.by_task), "after": dict(score.after)}
        for name, score in (("failures", failures), ("safety", safety))
        if score is not None
    }
    if failures is not None:
        rows = [[task, other, count] for (task, other), count in sorted(failures.interference.items())]
        found["failures"]["interference"] = rows
    return found


def _served(failure: Failure, task: int, atoms: Mapping[int, Sequence[str]]) -> list[int]:
    """Return the other tasks whose goal a failed rollout has brought about, or else whose object it handled."""
    others = [other for other in atoms if other != task]
    strange = [name for name in failure.handled if not any(_is_about(atom, name) for atom in atoms[task])]
    goals = [other for other in others if set(atoms[other]) & set(failure.instead)]
    return goals or [k for k in others if any(_is_about(a, name) for a in atoms[k] for name in strange)]


def _is_about(atom: str, name: str) -> bool:
    """Return whether an atom, such as (Open cabinet_1_top_region), is about an object or fixture, such as cabinet_1."""
    return f"{atom.strip('()').split(' ')[1]}_".startswith(f"{name}_")
