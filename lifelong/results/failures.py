"""Why rollouts of a run failed: by task, after each task, and for which learned task an erring rollout was of use."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from libero_env.sim.causes import CAUSES, Failure
from lifelong.results.records import Episodes
from lifelong.results.results import Results


@dataclass(frozen=True)
class FailureScore:
    """Causes of the failures in the success matrix of a run; positions of tasks count from 0.

    Attributes:
        causes: Causes that occur.
        by_task: Task -> number of rollouts by cause, at the end of the run.
        after: Learned task -> number of rollouts by cause, over all tasks that were measured after learning it.
        interference: Task of a failed rollout, learned task that it served -> number of rollouts at the end of the run:
            whose goal has an atom that held at its end, or else whose object or fixture it handled.
    """

    causes: tuple[str, ...]
    by_task: Mapping[int, Mapping[str, int]]
    after: Mapping[int, Mapping[str, int]]
    interference: Mapping[tuple[int, int], int]


def count_causes(episodes: Iterable[Episodes]) -> dict[str, int]:
    """Return how many episodes failed of each cause, in the order of the decision tree."""
    found = Counter(one.cause for part in episodes for one in part.failures if one is not None)
    return {cause: found[cause] for cause in CAUSES if found[cause]}


def causes_text(episodes: Iterable[Episodes]) -> str:
    """Return these numbers as text, such as `dropped 3, never reached 1`; empty without any."""
    return ", ".join(f"{cause} {count}" for cause, count in count_causes(episodes).items())


def failure_score(results: Results) -> FailureScore | None:
    """Return why the rollouts of a run's success matrix failed; None where none did, or it was not recorded."""
    cells = {(r.learned, r.task): r for r in results.evaluations() if r.phase == "matrix"}
    causes = count_causes(cells.values())
    if not causes:
        return None
    rows = sorted({learned for learned, _ in cells})
    last = {task: cells[rows[-1], task] for learned, task in cells if learned == rows[-1]}
    atoms = {task: cell.atoms for (_, task), cell in cells.items()}
    served = Counter(
        (task, other)
        for task, cell in last.items()
        for one in cell.failures
        if one is not None
        for other in _served(one, task, atoms)
    )
    return FailureScore(
        tuple(causes),
        {task: count_causes([last[task]]) for task in sorted(last)},
        {row: count_causes(cell for (learned, _), cell in cells.items() if learned == row) for row in rows},
        served,
    )


def failure_summary(results: Results) -> dict[str, object] | None:
    """Return the same as plain data; `interference` as rows of task, learned task and number of rollouts."""
    score = failure_score(results)
    if score is None:
        return None
    rows = [[task, other, count] for (task, other), count in sorted(score.interference.items())]
    return {"by_task": dict(score.by_task), "after": dict(score.after), "interference": rows}


def _served(failure: Failure, task: int, atoms: Mapping[int, Sequence[str]]) -> list[int]:
    """Return the other tasks whose goal a failed rollout has brought about, or else whose object it handled."""
    others = [other for other in atoms if other != task]
    strange = [name for name in failure.handled if not any(_is_about(atom, name) for atom in atoms[task])]
    goals = [other for other in others if set(atoms[other]) & set(failure.instead)]
    return goals or [k for k in others if any(_is_about(a, name) for a in atoms[k] for name in strange)]


def _is_about(atom: str, name: str) -> bool:
    """Return whether an atom, such as (Open cabinet_1_top_region), is about an object or fixture, such as cabinet_1."""
    return f"{atom.strip('()').split(' ')[1]}_".startswith(f"{name}_")
