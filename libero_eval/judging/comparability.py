"""Which results may be compared: the same protocol, tasks and environment, and starts in common."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.text import flatten, plain, shorten
from libero_eval.evaluation_file import WORLD, EvaluationResult, by_start, known_by
from libero_eval.protocols.naming import compared, horizon_text, protocol_label, section_of
from libero_eval.stats.episodes import Pairs
from lifelong.errors import ComparisonError
from lifelong.report.comparison import check_same_back_end
from lifelong.results.provenance import few_of

PASSING = ("instruction_set", "policy_threads")  # entries in which every machine differs
UNKNOWN = "not recorded"


@dataclass(frozen=True)
class Group:
    """One policy of a comparison.

    Attributes:
        label: Its name in tables.
        results: Its results: one, or several runs.
        paths: Where these were read.
    """

    label: str
    results: tuple[EvaluationResult, ...]
    paths: tuple[str, ...] = ()


@dataclass(frozen=True)
class Matched:
    """The episodes that two groups have in common.

    Attributes:
        pairs: Their outcomes; `pairs.tasks` are positions in `tasks`.
        tasks: Ids of the tasks.
        dropped: Number of episodes of each without a partner.
    """

    pairs: Pairs
    tasks: tuple[str, ...]
    dropped: tuple[int, int]


def check_comparable(groups: Sequence[Group], allow: Iterable[str] = ()) -> list[str]:
    """Compare protocols, tasks and environments of all results.

    Each is compared with the first; a task that this has not, with the first result that has it.

    Args:
        groups: Policies to be compared.
        allow: Names of settings that may differ, or of groups of them: `protocol`, `protocol.episode`,
            `environment.robot`, `tasks`.

    Returns:
        Remarks on what differs and was allowed, or does not matter much, on episodes that ended with errors, and on
        results that were stopped.

    Raises:
        ComparisonError: A setting differs; the message names both values. Backends are never mixed.
        UnknownNameError: No result has a setting that `allow` names.
    """
    rows = [(s.label, r) for s in groups for r in s.results]
    base_label, base = rows[0]
    check_same_back_end({label: result.backend for label, result in rows})
    expected = {key: (base_label, value) for key, value in settings(base).items()}
    known = {"protocol", "environment", "tasks"}.union(*(settings(result) for _, result in rows))
    for name in allow:
        if not any(is_of(key, name) for key in known):
            raise UnknownNameError("setting to allow", name, {k for k in known if "/" not in k})
    refused, notes = dict[str, str](), list[str]()
    undescribed = dict[str, None]()  # tasks whose digest one of two lacks
    for label, result in rows[1:]:
        others = settings(result)
        for key in sorted(expected.keys() | others.keys()):
            if key.startswith("tasks.") and not (key in expected and key in others):
                continue  # a task of one of them only: its episodes have no partner
            first_label, value = expected.get(key, (base_label, UNKNOWN))
            values = value, others.get(key, UNKNOWN)
            if UNKNOWN in values and key.endswith(".digest"):
                undescribed[key.removeprefix("tasks.").removesuffix(".digest")] = None
                continue
            if values[0] == values[1]:
                continue
            one, other = (shorten(str(value), 60) for value in values)
            text = f"{key}: {one} in {first_label}, {other} in {label}"
            if UNKNOWN in values and key.startswith("environment."):
                notes.append(f"{text}; taken to be the same")
            elif any(is_of(key, a) for a in allow):
                notes.append(f"{text}; allowed")
            else:
                refused[text] = key
        notes += [
            f"{key}: {first} in {base_label}, {other} in {label}"
            for key, (first, other) in _lesser_differences(base, result).items()
        ]
        tasks = {key: (label, value) for key, value in others.items() if key.startswith("tasks.")}
        expected = tasks | expected
    if refused:
        names = " ".join(f"--allow {key}" for key in dict.fromkeys(refused.values()))
        lines = "\n  ".join(refused)
        raise ComparisonError(
            f"these results cannot be compared, as they were made differently:\n  {lines}\n"
            f"evaluate again with the same settings, or compare nevertheless with {names}"
        )
    if undescribed:
        notes.append(f"digest of {few_of([*undescribed])}: {UNKNOWN}; taken to be the same task")
    notes += [f"{label}: protocol {text}" for label, text in protocol_labels(rows).items()]
    remarks = [f"{label}, {t.task}: {t.error_note}" for label, r in rows for t in r.tasks if t.error_note]
    remarks += [
        f"{label}: {result.stop_note}; of all tests and intervals here only the sequential test allows for that"
        for label, result in rows
        if result.stopped
    ]
    return [*dict.fromkeys(notes), *remarks]


def is_of(key: str, name: str) -> bool:
    """Return whether a setting is the one of a name, or in the group of that name."""
    return f"{key}.".startswith(f"{name}.")


def protocol_labels(rows: Iterable[tuple[str, EvaluationResult]]) -> dict[str, str]:
    """Return what the protocols of results that changed theirs are called, by labels; one for all if they agree."""
    labels: dict[str, list[str]] = {}
    for label, result in rows:
        labels.setdefault(protocol_label(result.protocol, result.suites), []).append(label)
    changed = {text: of for text, of in labels.items() if ", changed: " in text}
    return {"all" if len(labels) == 1 else ", ".join(dict.fromkeys(of)): text for text, of in changed.items()}


def settings(result: EvaluationResult) -> dict[str, Any]:
    """Return everything that must be equal, flat, by dotted name: protocol, environment, instructions of the tasks."""
    tasks = {
        r.task: {"name": r.name, "instruction": r.instruction, "digest": r.digest or UNKNOWN}
        for r in result.tasks
    }
    return flatten(
        plain({"protocol": compared(result.protocol), "environment": result.world, "tasks": tasks})
    )


def facts(result: EvaluationResult) -> list[tuple[str, str]]:
    """Return what a reader needs to know of how the episodes were run, by name."""
    protocol, environment = result.protocol, result.environment
    models = (environment.get("models"), environment.get("models_digest"))
    world, horizon = section_of(protocol, "world"), section_of(protocol, "episode").get("horizon")
    found = {
        "tasks": ", ".join(result.suite_labels.values()),
        "protocol": protocol_label(protocol, result.suites),
        "digest": protocol.get("digest"),
        "models": " ".join(str(value) for value in models if value),
        "initial states": {"builtin": "this package's", "original": "LIBERO's"}.get(
            str(world.get("init_states"))
        ),
        "robot": environment.get("robot"),
        "perturbed by": world.get("perturb"),
        "control rate": f"{rate} Hz" if (rate := world.get("control_freq")) else "",
        "horizon": f"{horizon_text(horizon, result.suites)} steps" if horizon else "",
        "clock": section_of(protocol, "action").get("clock"),
        "MuJoCo": result.versions.get("mujoco"),
        "episodes": sum(len(task.init_states) for task in result.tasks),
        "finished": str(result.times.get("finished", "")).replace("T", " ").replace("+00:00", " UTC"),
    }
    return [(name, str(value)) for name, value in found.items() if value]


def match(first: Group, second: Group) -> Matched:
    """Pair the episodes of two groups by task and initial state.

    Raises:
        ComparisonError: They have no start in common.
    """
    tables = [[by_start(r.tasks) for r in group.results] for group in (first, second)]
    shared = set.intersection(*(set(t) for group in tables for t in group))
    if not shared:
        raise ComparisonError(
            f"{first.label} and {second.label} were not evaluated in the same starts: "
            f"{starts_text(first)} against {starts_text(second)}"
        )
    order = [t.task for t in first.results[0].tasks if any(key[0] == t.task for key in shared)]
    keys = sorted(shared, key=lambda key: (order.index(key[0]), key[1]))
    columns = [np.array([[t[key] for t in group] for key in keys], dtype=bool) for group in tables]
    dropped = [sum(len(t) - len(shared) for t in group) for group in tables]
    pairs = Pairs(
        tasks=np.array([order.index(task) for task, _ in keys]),
        starts=np.array([start for _, start in keys]),
        first=columns[0],
        second=columns[1],
    )
    return Matched(pairs, tuple(order), (dropped[0], dropped[1]))


def same_policy(first: EvaluationResult, second: EvaluationResult) -> bool:
    """Return whether two results are of the same policy, apart from the seed: the same weights where they are known."""
    known = all(r.evaluated.get("weights") for r in (first, second))
    other = ("seed", *(("run", "after") if known else ()))
    a, b = ({k: v for k, v in known_by(r.evaluated).items() if k not in other} for r in (first, second))
    return a == b


def _lesser_differences(first: EvaluationResult, second: EvaluationResult) -> dict[str, tuple[Any, Any]]:
    """Return versions and properties of the environment that differ but do not forbid a comparison."""
    both = ({"versions": r.versions, "environment": r.environment} for r in (first, second))
    a, b = (flatten(values) for values in both)
    return {
        key: (a[key], b[key])
        for key in sorted(a.keys() & b.keys(), reverse=True)
        if a[key] != b[key]
        and not key.partition(".")[2].startswith(WORLD)
        and key.partition(".")[2] not in PASSING
    }


def starts_text(group: Group) -> str:
    """Return which tasks and initial states the first result of a group is of, for messages."""
    result = group.results[0]
    task = result.tasks[0]
    return f"{len(result.tasks)} tasks from {task.task}, starts {_ranges(task.init_states)}"


def _ranges(numbers: Sequence[int]) -> str:
    """Format whole numbers as ranges: 0–9, 20, 40–49."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in parts)
