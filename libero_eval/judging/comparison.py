"""Contrast of evaluated policies, start by start: differences, tests, a control arm, and what could be shown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.sim.backend import MUJOCO
from libero_env.storage import write_json
from libero_env.text import json_safe
from libero_eval.evaluation_file import by_start, overall
from libero_eval.judging.comparability import Group, check_comparable, facts, match, same_policy, settings
from libero_eval.judging.group_scores import GroupScores, group_scores
from libero_eval.stats.episodes import PairedDifference, difference, score_interval
from libero_eval.stats.power import Question, shown_difference
from libero_eval.stats.sequential import SequentialTest, sequential_test
from lifelong.errors import ConfigError, writing
from lifelong.results.failures import count_causes, count_quadrants
from lifelong.stats.intervals import ALPHA, LEAST_EPISODES, Estimate, holm

FORMAT = "libero-comparison/1"


@dataclass(frozen=True)
class Row:
    """The difference on all tasks together, on a suite, or on a task.

    Attributes:
        name: `all`, a suite, or the id of a task.
        title: The instruction of a task; empty otherwise.
        adjusted: P-value adjusted by Holm over the family: all comparisons of this kind of row; for tasks, the tasks
            of this comparison. None for a control arm, which is not tested for being better.
    """

    name: str
    title: str
    difference: PairedDifference
    adjusted: float | None = None


@dataclass(frozen=True)
class Contrast:
    """Two policies in the same starts, first minus second.

    Attributes:
        first: Label of the first.
        second: Label of the second.
        total: The difference on all tasks.
        suites: That on each suite, if there are several.
        tasks: That on each task.
        sequential: Test that may be stopped early; None if a policy has several runs.
        shown: Difference that so many pairs would have shown in four of five cases, as often as these two differ, at
            the first step of Holm's procedure; NaN if unknown.
        dropped: Number of episodes of each without a partner; they are not counted.
    """

    first: str
    second: str
    total: Row
    suites: tuple[Row, ...]
    tasks: tuple[Row, ...]
    sequential: SequentialTest | None
    shown: float
    dropped: tuple[int, int]


@dataclass(frozen=True)
class Rate:
    """A policy in a table: its runs, episodes, mean success over tasks, causes of failures, and safety."""

    label: str
    paths: tuple[str, ...]
    runs: int
    episodes: int
    errors: int
    success: Estimate
    causes: Mapping[str, int]
    safety: Mapping[str, int]


@dataclass(frozen=True)
class Gate:
    """Whether the second of two policies is worse than the first by more than a margin.

    Attributes:
        margin: Loss of success that is accepted.
        loss: Success of the first minus that of the second, with Tango's interval at the level of the tests.
        pairs: Number of starts that both were evaluated in.
        enough: Number of pairs that would decide it if the policies went on to differ as they do; None where more pairs
            decide nothing, as the loss is the margin.
    """

    margin: float
    loss: Estimate
    pairs: int
    enough: int | None

    @property
    def verdict(self) -> str:
        """`regression`: the whole interval is above the margin; `no regression`: none of it; otherwise `undecided`."""
        if self.loss.low > self.margin:
            return "regression"
        return "no regression" if self.loss.high <= self.margin else "undecided"


def gate(comparison: "Comparison", margin: float) -> Gate:
    """Decide whether the second policy of a comparison is worse than the first by more than a margin.

    Raises:
        ConfigError: The comparison is not one of two policies with a result each, of five starts or more, which
            `--until` did not stop.
    """
    labels = [rate.label for rate in comparison.rates]
    found = [c for c in (*comparison.comparisons, *comparison.controls) if [c.first, c.second] == labels]
    counts = found[0].total.difference.counts if found else None
    if counts is None:
        raise ConfigError(
            "--gate judges two results: first the one to keep up with, then the one that is judged"
        )
    if comparison.stopped:
        raise ConfigError(
            f"--gate does not judge results that --until stopped ({', '.join(comparison.stopped)}): its interval holds "
            "for a number of starts that was fixed before; the same libero eval without --until goes on to all of them"
        )
    if counts.pairs < LEAST_EPISODES:
        raise ConfigError(
            f"--gate needs {LEAST_EPISODES} starts that both have, and there are {counts.pairs}"
        )
    loss = score_interval(counts, 1 - comparison.alpha)
    away = abs(loss.value - margin)
    half = loss.high - loss.value if loss.value < margin else loss.value - loss.low
    enough = math.ceil(counts.pairs * (half / away) ** 2) if away else None  # intervals narrow with the root
    return Gate(margin, loss, counts.pairs, enough)


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found.

    Attributes:
        rates: The policies.
        comparisons: Each pair of them.
        controls: The same policy twice, if there is such a pair: what arises by chance alone.
        groups: Aggregates over runs; None unless each policy has at least two, and all have starts in common.
        notes: Remarks for the reader.
        facts: How the episodes of the first result were run, by name.
        backend: Backend that simulated all of it.
        alpha: Probability of a false difference in a family.
        stopped: Labels of the policies with a result that `--until` stopped.
    """

    rates: tuple[Rate, ...]
    comparisons: tuple[Contrast, ...]
    controls: tuple[Contrast, ...]
    groups: GroupScores | None
    notes: tuple[str, ...]
    facts: tuple[tuple[str, str], ...] = ()
    alpha: float = ALPHA
    backend: str = MUJOCO
    stopped: tuple[str, ...] = ()

    def to_plain(self, gate: Gate | None = None) -> dict[str, Any]:
        """Return everything as plain data for JSON, with what a gate says."""
        plain = json_safe({"format": FORMAT, **asdict(self)})
        if gate:
            plain["gate"] = {**json_safe(asdict(gate)), "verdict": gate.verdict}
        if self.groups:
            plain["groups"]["improvement"] = [
                {"of": a, "over": b, **asdict(e)} for (a, b), e in self.groups.improvement.items()
            ]
        return plain


def compare_groups(
    groups: Sequence[Group],
    *,
    control: tuple[Group, Group] | None = None,
    allow: Sequence[str] = (),
    alpha: float = ALPHA,
) -> Comparison:
    """Compare every pair of policies in the starts that they have in common.

    Args:
        groups: At least two policies. Two results of one policy with different seeds are also a control arm.
        control: Two results of one policy, for the control arm alone.
        allow: Settings that may differ, see `check_comparable`.
        alpha: Probability of a false difference in each family of tests.

    Raises:
        ComparisonError: The results were made differently, or have no start in common.
        ConfigError: There are fewer than two policies, or two of one name.
        MissingPackageError: rliable, for several runs of a policy, is not installed.
    """
    if len(groups) < 2 and not (control and not groups):
        raise ConfigError("a comparison needs two results, or --control with two results of one policy")
    labels = [s.label for s in groups]
    if twice := sorted({name for name in labels if labels.count(name) > 1}):
        raise ConfigError(f"two policies are called {', '.join(twice)}; write NAME=RESULT to name them")
    for group in groups:
        for (i, one), (k, other) in combinations(enumerate(group.results, 1), 2):
            if same_policy(one, other) and one.outcomes == other.outcomes:
                raise ConfigError(
                    f"results {i} and {k} of {group.label} are one run, which counts once; leave one out"
                )
    notes = check_comparable([*groups, *(control or ())], allow)
    rivals: list[tuple[Group, Group]] = []
    controls = [control] if control else []
    for a, b in combinations(groups, 2):
        (controls if _is_control(a, b) else rivals).append((a, b))
    notes += [note for a, b in controls for note in _control_notes(a, b)]
    comparisons = _adjusted([_compare(a, b, alpha, len(rivals)) for a, b in rivals])
    notes += [
        f"{c.first} and {c.second}: {c.total.difference.pairs} pairs; without a partner and not counted: "
        f"{c.dropped[0]} episodes of {c.first}, {c.dropped[1]} of {c.second}"
        for c in comparisons
        if any(c.dropped)
    ]
    if not controls:
        notes.append(
            "no control arm: evaluate one of the policies again with another --seed and name both results "
            "with --control, to see which differences arise by chance alone"
        )
    scores = _group_scores(groups)
    if scores is None and groups and all(len(s.results) > 1 for s in groups):
        notes.append("no start is common to all runs of all policies: there are no aggregates over runs")
    first = (groups or control)[0].results[0]  # type: ignore[index]  # there is one of them
    backend = first.backend
    if backend != MUJOCO:
        notes.append(f"simulated by backend={backend}; not to be compared with results of others")
    return Comparison(
        rates=tuple(_rate(s) for s in groups),
        comparisons=tuple(comparisons),
        controls=tuple(_compare(a, b, alpha) for a, b in controls),
        groups=scores,
        notes=tuple(notes),
        facts=tuple(facts(first)),
        alpha=alpha,
        backend=backend,
        stopped=tuple(s.label for s in groups if any(result.stopped for result in s.results)),
    )


def write_comparison(comparison: Comparison, path: Path, gate: Gate | None = None) -> Path:
    """Write everything as JSON, in one step; numbers that are not finite become null.

    Raises:
        ResultsError: The file cannot be written.
    """
    with writing(path, "the comparison"):
        write_json(path, comparison.to_plain(gate))
    return path


def _compare(a: Group, b: Group, alpha: float, tests: int = 1) -> Contrast:
    matched = match(a, b)
    pairs, names = matched.pairs, matched.tasks
    suites = list(dict.fromkeys(name.partition("/")[0] for name in names))
    titles = {t.task: t.instruction for r in a.results for t in r.tasks}
    total = difference(pairs)
    by_suite = [
        Row(s, "", difference(pairs.of_tasks([i for i, n in enumerate(names) if n.startswith(s + "/")])))
        for s in suites
    ]
    by_task = []
    for i, name in enumerate(names):
        of_task = pairs.of_tasks([i])
        draws = 0 if of_task.single else 1999  # of single runs, Tango's interval needs no bootstrap beside it
        by_task.append(Row(name, titles[name], difference(of_task, draws=draws)))
    return Contrast(
        first=a.label,
        second=b.label,
        total=Row("all", "", total),
        suites=tuple(by_suite) if len(suites) > 1 else (),
        tasks=tuple(by_task),
        sequential=sequential_test(pairs, alpha) if pairs.single else None,
        shown=_shown(total, alpha, tests),
        dropped=matched.dropped,
    )


def _adjusted(comparisons: Sequence[Contrast]) -> list[Contrast]:
    """Adjust the p-values by Holm: totals together, suites of all comparisons together, tasks of each comparison."""
    totals = iter(_family([c.total for c in comparisons]))
    suites = iter(_family([row for c in comparisons for row in c.suites]))
    return [
        replace(
            contrast,
            total=next(totals),
            suites=tuple(next(suites) for _ in contrast.suites),
            tasks=tuple(_family(contrast.tasks)),
        )
        for contrast in comparisons
    ]


def _family(rows: Sequence[Row]) -> list[Row]:
    adjusted = holm([row.difference.p_value for row in rows])
    return [replace(row, adjusted=value) for row, value in zip(rows, adjusted, strict=True)]


def _shown(total: PairedDifference, alpha: float, tests: int) -> float:
    """Return the difference that as many pairs show in four of five cases; NaN where it cannot be computed."""
    if total.counts is None:
        return math.nan
    base = max(total.first, total.second)
    if not 0 < base < 1 or not total.counts.discordant:
        return math.nan
    # downwards: near 100 % there is no room above
    question = Question(base, -base / 1000, alpha=alpha, tests=tests)
    return shown_difference(question, total.pairs, discordance=total.counts.discordant / total.pairs)


def _rate(group: Group) -> Rate:
    tasks = [task for result in group.results for task in result.tasks]
    return Rate(
        label=group.label,
        paths=group.paths,
        runs=len(group.results),
        episodes=sum(len(task.successes) for task in tasks),
        errors=sum(error is not None for task in tasks for error in task.errors),
        success=overall(tasks, stopped=any(result.stopped for result in group.results)),
        causes=count_causes(tasks),
        safety=count_quadrants(tasks),
    )


def _group_scores(groups: Sequence[Group]) -> GroupScores | None:
    """Return aggregates over runs, of the starts that all runs have; None without any, or unless each has two runs."""
    if not groups or any(len(s.results) < 2 for s in groups):
        return None
    won = {s.label: [by_start(r.tasks) for r in s.results] for s in groups}
    shared = sorted(set.intersection(*(set(table) for tables in won.values() for table in tables)))
    starts = [[key for key in shared if key[0] == task] for task in dict.fromkeys(task for task, _ in shared)]
    if not starts:
        return None
    return group_scores(
        {
            label: np.array([[np.mean([table[key] for key in keys]) for keys in starts] for table in tables])
            for label, tables in won.items()
        }
    )


def _is_control(a: Group, b: Group) -> bool:
    """Return whether both are one policy under the same settings, so that they differ by chance alone."""
    if len(a.results) != 1 or len(b.results) != 1:
        return False
    first, second = a.results[0], b.results[0]
    return same_policy(first, second) and settings(first) == settings(second)


def _control_notes(a: Group, b: Group) -> list[str]:
    first, second = a.results[0], b.results[0]
    if not same_policy(first, second):
        return [
            f"control arm: {a.label} and {b.label} are not results of one policy; it says nothing about chance"
        ]
    if first.outcomes == second.outcomes:
        return [
            f"control arm: the outcomes of {a.label} and {b.label} are equal to the bit, so the policy and the "
            "simulation are deterministic here, or the file is the same; repeat with another --seed, other starts "
            "or other hardware to see chance"
        ]
    return []
