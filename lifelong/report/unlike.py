"""In what the runs of a comparison differ besides their methods, as their records tell it."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any

from libero_env.demos.agreement import UNSTATED
from lifelong.errors import ComparisonError
from lifelong.report.runs import BASICS, Group, Run, settings_of
from lifelong.results.provenance import few_of
from lifelong.results.records import RunRecord

_WORLD = ("models digest", "mujoco")


def unlike(groups: Sequence[Group]) -> list[str]:
    """Return a sentence for all in which runs differ besides their methods' names, or that a record does not tell."""
    return [
        *(
            f"Runs differ in {text}."
            for text in _unlike_facts(groups, (*_WORLD, "source", "estimate of FWT", "tasks learned"))
        ),
        *(
            f"{group.label} seed {run.record.seed} has learned {_progress(run)} tasks; it is not counted."
            for group in groups
            for run in group.behind
        ),
        *_unlike_draws(groups),
        *_unlike_demonstrations(groups),
        *_unlike_settings(groups),
    ]


def check_same_world(groups: Sequence[Group]) -> None:
    """Check that runs are of one world: of the same models, simulated by the same MuJoCo.

    Raises:
        ComparisonError: They are not; the message names runs of each. What no record tells is not refused.
    """
    if found := _unlike_facts(groups, _WORLD, unknown=False):
        raise ComparisonError(
            f"runs of different worlds are only compared with --other-worlds: they differ in {'; in '.join(found)}"
        )


def _unlike_facts(groups: Sequence[Group], names: Sequence[str], *, unknown: bool = True) -> list[str]:
    """Return the facts of the records in which runs differ, each with its values and the runs of each value."""
    runs = {f"{group.label} seed {run.record.seed}": _facts(run) for group in groups for run in group.runs}
    lines = []
    for name in names:
        values = ((facts.get(name.replace(" ", "_"), facts.get(name)), run) for run, facts in runs.items())
        found = _by_value((value or "unknown", run) for value, run in values if value is not None or unknown)
        if len(found) > 1:
            lines.append(
                f"{name} ({'; '.join(f'{value}: {few_of(alike)}' for value, alike in found.items())})"
            )
    return lines


def _facts(run: Run) -> dict[str, Any]:
    own = {"estimate of FWT": run.results.transfer, "tasks learned": _progress(run)}
    return {**run.record.versions, **run.record.conditions, **own}


def _by_value(named: Iterable[tuple[Hashable, str]]) -> dict[Any, list[str]]:
    """Return the names of each value, in their order."""
    found: dict[Any, list[str]] = {}
    for value, name in named:
        found.setdefault(value, []).append(name)
    return found


def _progress(run: Run) -> str:
    return f"{run.learned} of {len(run.record.tasks)}"


def _unlike_draws(groups: Sequence[Group]) -> list[str]:
    """Return a sentence where methods were run with other seeds, orders of tasks, or seeds of demonstrations."""
    draws: dict[str, Callable[[RunRecord], Any]] = {
        "seeds": lambda record: record.seed,
        "tasks or their orders": lambda record: record.tasks,
        "seeds of the demonstrations (data.seed)": lambda record: record.demonstrations_seed,
        "seeds of the sampled cells (eval.cells_seed)": lambda record: (
            "own" if record.cells_seed == record.seed else record.cells_seed
        ),
    }
    lines = []
    for name, drawn in draws.items():
        sets: dict[Any, dict[Any, list[str]]] = {}
        for group in groups:
            first = group.runs[0].record  # other benchmarks and lengths are told elsewhere
            alike = sets.setdefault((first.benchmark, len(first.tasks)), {})
            alike.setdefault(frozenset(drawn(r.record) for r in group.runs), []).append(group.label)
        lines += [
            f"The {name} differ between methods: {' against '.join(map(few_of, alike.values()))}."
            for alike in sets.values()
            if len(alike) > 1
        ]
    drawn_once = [
        group.label
        for group in groups
        if len(group.runs) > 1
        and {r.record.cells for r in group.runs} == {"sampled"}
        and len({r.record.cells_seed for r in group.runs}) == 1
    ]
    if drawn_once:
        lines.append(
            f"The same cells are sampled in all runs of {few_of(drawn_once)}: what NBT and AUC miss by that is in no "
            "interval (eval.cells_seed)."
        )
    subsets = {group.label: len({frozenset(r.record.tasks) for r in group.runs}) for group in groups}
    return lines + [
        f"The runs of {name} learn {n} different sets of tasks." for name, n in subsets.items() if n > 1
    ]


def _unlike_demonstrations(groups: Sequence[Group]) -> list[str]:
    """Return a sentence for each set of runs that learned the same tasks from other demonstrations of one `data.seed`.

    That happens when they are given others or another number of them, or when the expert was improved in between.
    """
    sets: dict[Any, dict[tuple[tuple[str, int, str, str], ...], list[str]]] = {}
    unknown = []
    for group in groups:
        for run in group.runs:
            name = f"{group.label} seed {run.record.seed}"
            if (found := run.results.demonstrations) is None:
                unknown.append(name)
                continue
            columns = (run.record.tasks, found.counts, found.generators, found.digests)
            learned = tuple(sorted(zip(*columns, strict=True)))
            key = run.record.benchmark, run.record.demonstrations_seed, tuple(sorted(run.record.tasks))
            sets.setdefault(key, {}).setdefault(learned, []).append(name)
    lines = (
        [f"No record tells which demonstrations these learned from: {few_of(unknown)}."] if unknown else []
    )
    for (first, names), *others in (list(alike.items()) for alike in sets.values()):
        for learned, others_names in others:
            differ = [(was, now) for was, now in zip(first, learned, strict=True) if was != now]
            then, now = (_demonstrations_text(side) for side in zip(*differ, strict=True))
            lines.append(
                f"{few_of(others_names)} learned from other demonstrations of {few_of([was[0] for was, _ in differ])} "
                f"({now}) than {few_of(names)} ({then}): a difference between them may be due to that."
            )
    return lines


def _demonstrations_text(rows: Sequence[tuple[str, int, str, str]]) -> str:
    """Return number and origin of the demonstrations of tasks: `50 a task by scripted-expert-16`."""
    _, counts, generators, _ = zip(*rows, strict=True)
    span = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    return f"{span} a task by {', '.join(dict.fromkeys(name or UNSTATED for name in generators))}"


def _unlike_settings(groups: Sequence[Group]) -> list[str]:
    """Return a sentence with the settings that differ between methods, and that their names do not tell."""
    known = [(group.label, settings_of(group.runs[0])) for group in groups if group.runs[0].config]
    one_policy = len({settings["policy"] for _, settings in known}) == 1
    named = ("algo.",) if one_policy else ("algo.", "policy.")  # keys of another policy mean something else
    keys = {key for _, settings in known for key in settings if not key.startswith(named)}
    untold = []
    for key in sorted(keys - set(BASICS)):
        found = _by_value((settings.get(key), label) for label, settings in known)
        told = all(
            f"{key.rpartition('.')[2]} {settings[key]}" in label
            for label, settings in known
            if key in settings
        )
        if len(found) > 1 and not told:
            values = ", ".join(f"{value} of {few_of(labels)}" for value, labels in found.items())
            untold.append(f"{key.rstrip('.')} ({values})")
    return [f"Settings differ that no method's name tells: {few_of(untold, 6)}."] if untold else []
