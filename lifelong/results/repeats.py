"""Which evaluations repeat the rollouts of an earlier one, because nothing that acts has changed in between."""

from collections.abc import Mapping

from lifelong.results.records import EvalRecord


def repeated_rows(evaluations: Mapping[tuple[int, int], EvalRecord]) -> dict[tuple[int, int], int]:
    """Return, by (row, task), the first row of the task's column whose rollouts this evaluation repeats, or its own.

    Rollouts are the same where starts, outcomes and lengths are. Where all episodes failed, lengths say nothing; these
    count as repeated if every other column of the run is.

    Args:
        evaluations: The evaluation of every cell of the matrix.
    """
    columns: dict[int, list[int]] = {}
    for row, task in sorted(evaluations):
        columns.setdefault(task, []).append(row)
    telling = {
        task: any(any(evaluations[row, task].successes) for row in rows) for task, rows in columns.items()
    }
    followed = [task for task, rows in columns.items() if len(rows) > 1 and telling[task]]
    frozen = bool(followed) and all(
        _same(evaluations[columns[task][0], task], evaluations[row, task])
        for task in followed
        for row in columns[task]
    )
    found: dict[tuple[int, int], int] = {}
    for task, rows in columns.items():
        for place, row in enumerate(rows):
            before = rows[place - 1]
            repeats = place > 0 and _same(evaluations[before, task], evaluations[row, task])
            record = evaluations[row, task]
            known = any(record.successes) or frozen or record.same_as is not None
            found[row, task] = found[before, task] if repeats and known else row
    return found


def _same(a: EvalRecord, b: EvalRecord) -> bool:
    return (a.init_states, a.successes, a.lengths) == (b.init_states, b.successes, b.lengths)
