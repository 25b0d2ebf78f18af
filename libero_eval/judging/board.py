"""A leaderboard of evaluated policies: success with intervals, and tiers of what paired tests do not tell apart."""

import os
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from libero_env.text import Table, counted, shorten
from libero_eval.evaluation_file import EvaluationResult, by_start, overall, suite_label
from libero_eval.judging.comparability import Group, check_comparable, facts, is_of, settings, starts_text
from libero_eval.judging.page import OF_ONE, interval_text, p_text
from libero_eval.repeating import again
from libero_eval.stats.episodes import PairedDifference, Pairs, difference
from lifelong.errors import ComparisonError
from lifelong.report.tables import percent, save_page
from lifelong.stats.intervals import ALPHA, Estimate, holm

STARTS = "starts"  # what `allow` names where policies ran other episodes
TIERS = (
    "the first policy of a tier is shown to be worse than one of the tier above; any other two of different tiers need "
    "not differ, and a further policy may move them"
)


@dataclass(frozen=True)
class Standing:
    """A policy on the board.

    Attributes:
        label: Its name.
        tier: Number of its tier, from 1.
        success: Mean success over tasks in the episodes that all policies ran.
        suites: That of each suite in all of its episodes, as on the page of the evaluation.
        parts: Number of the tasks of each suite, where others ran more.
        episodes: Number of its episodes.
        finished: Day on which it was evaluated; empty where that is not recorded.
        paths: Files of its results.
    """

    label: str
    tier: int
    success: Estimate
    suites: dict[str, Estimate]
    parts: dict[str, int]
    episodes: int
    finished: str
    paths: tuple[str, ...]


@dataclass(frozen=True)
class Pair:
    """Two policies in the episodes that all ran, first minus second; `adjusted` is the p-value after Holm."""

    first: str
    second: str
    difference: PairedDifference
    adjusted: float


@dataclass(frozen=True)
class Board:
    """Policies, best first.

    Attributes:
        rows: The policies.
        suites: Name of each suite -> its label, see `suite_label`.
        shared: Number of episodes that all of them ran.
        pairs: Every two of them.
        notes: What differs between the results and was allowed, or matters little.
        alpha: Probability of a false difference among all pairs.
    """

    rows: tuple[Standing, ...]
    suites: dict[str, str]
    shared: int
    pairs: tuple[Pair, ...]
    notes: tuple[str, ...]
    alpha: float


def make_board(entries: Sequence[Group], allow: Iterable[str] = (), alpha: float = ALPHA) -> Board:
    """Rank policies. Results of one policy on other tasks make one row, and so does a copy of a result.

    Args:
        entries: Results, each a group of its own.
        allow: Settings that may differ, see `check_comparable`; `starts`: the episodes, of which the shared ones count.
        alpha: Probability of a false difference among all pairs.

    Raises:
        ComparisonError: The results were made differently, or have no episode in common; the message names both values.
    """
    notes = check_comparable(entries, [name for name in allow if name != STARTS])
    groups = _joined(entries)
    notes += _check_starts(groups, STARTS in allow)
    tables = [by_start(group.results[0].tasks) for group in groups]
    keys = sorted(set.intersection(*map(set, tables)))
    if not keys:
        raise ComparisonError(f"no episode is common to {', '.join(group.label for group in groups)}")
    won = np.array([[table[key] for key in keys] for table in tables], dtype=bool)
    numbers = {task: number for number, task in enumerate(dict.fromkeys(task for task, _ in keys))}
    tasks, starts = np.array([numbers[task] for task, _ in keys]), np.array([start for _, start in keys])
    rates = [_success(group.results[0], keys) for group in groups]
    order = sorted(range(len(groups)), key=lambda i: (-rates[i].value, groups[i].label))
    groups, rates, won = [groups[i] for i in order], [rates[i] for i in order], won[order]
    rivals = list(combinations(range(len(groups)), 2))
    found = [difference(Pairs(tasks, starts, won[[a]].T, won[[b]].T), draws=0) for a, b in rivals]
    adjusted = dict(zip(rivals, holm([one.p_value for one in found]), strict=True))
    tiers = _tiers(len(groups), {pair for pair, p in adjusted.items() if p <= alpha})
    ran: dict[str, dict[str, None]] = {}  # tasks of any policy, by suite
    for task in (task for group in groups for task in group.results[0].tasks):
        ran.setdefault(task.suite, {})[task.task] = None
    rows = (_standing(*values, ran) for values in zip(groups, tiers, rates, strict=True))
    return Board(
        rows=tuple(rows),
        suites={suite: suite_label(suite, ids) for suite, ids in ran.items()},
        shared=len(keys),
        pairs=tuple(
            Pair(groups[a].label, groups[b].label, one, adjusted[a, b])
            for (a, b), one in zip(rivals, found, strict=True)
        ),
        notes=tuple(notes),
        alpha=alpha,
    )


def alike(
    entries: Sequence[Group], searched: Sequence[bool], allow: Iterable[str] = ()
) -> tuple[list[Group], list[str]]:
    """Return the results that can be ranked together, and a note for each that was only found in a folder and cannot.

    Args:
        entries: Results, each a group of its own.
        searched: Whether each was found in a folder; those that were named stay.
        allow: Settings that may differ, see `check_comparable`.
    """
    allowed = tuple(allow)

    def key(entry: Group) -> tuple[tuple[str, str], ...]:
        values = settings(entry.results[0]).items()
        kept = ((k, str(value)) for k, value in values if not any(is_of(k, a) for a in ("tasks", *allowed)))
        return tuple(sorted(kept))

    keys = [key(entry) for entry in entries]
    kinds = Counter(k for k, found in zip(keys, searched, strict=True) if not found) or Counter(keys)
    ranked = max(kinds, key=lambda k: (kinds[k], -keys.index(k)))
    kept, notes = list[Group](), list[str]()
    for entry, k, found in zip(entries, keys, searched, strict=True):
        if found and k != ranked:
            here = dict(ranked)
            differ = [f"{name} is {shorten(value, 40)}" for name, value in k if here.get(name) != value]
            differ.sort(key=lambda text: not text.startswith("protocol.name "))
            told = ", ".join(differ[:3]) or "settings are others"
            notes.append(f"left out: {entry.paths[0]}, whose {told}; a board of it alone ranks it")
        else:
            kept.append(entry)
    return kept, notes


def _joined(entries: Sequence[Group]) -> list[Group]:
    """Return a group for each policy: results of the same one on other tasks are one, and so are copies."""
    groups: list[Group] = []
    for entry in entries:
        (result,) = entry.results
        for place, group in enumerate(groups):
            (first,) = group.results
            new = [task for task in result.tasks if task not in first.tasks]
            alike = first.evaluated == result.evaluated and first.protocol == result.protocol
            if alike and not {task.task for task in new} & {task.task for task in first.tasks}:
                stopped = first.stopped or result.stopped
                whole = replace(first, tasks=(*first.tasks, *new), stopped=stopped)
                groups[place] = Group(group.label, (whole,), (*group.paths, *entry.paths))
                break
        else:
            groups.append(entry)
    labels = [group.label for group in groups]
    return [
        replace(group, label=f"{group.label} ({group.paths[0]})") if labels.count(group.label) > 1 else group
        for group in groups
    ]


def _check_starts(groups: Sequence[Group], allowed: bool) -> list[str]:
    """Return a note for each policy that ran other episodes than the first one.

    Raises:
        ComparisonError: One did, and that is not allowed.
    """
    ran = [
        {(task.task, start) for task in group.results[0].tasks for start in task.starts} for group in groups
    ]
    lines = [
        f"{STARTS}: {starts_text(groups[0])} in {groups[0].label}, {starts_text(group)} in {group.label}"
        for group, episodes in zip(groups, ran, strict=True)
        if episodes != ran[0]
    ]
    if lines and not allowed:
        listed = "\n  ".join(lines)
        raise ComparisonError(
            f"these results are not of the same episodes:\n  {listed}\n"
            f"evaluate the same ones, or rank by those that all have with --allow {STARTS}"
        )
    return [f"{line}; allowed" for line in lines]


def _tiers(count: int, apart: set[tuple[int, int]]) -> list[int]:
    """Return the tier of each policy, best first: one that is worse than any of the tier above begins the next.

    Args:
        count: Number of policies.
        apart: Pairs of which the first is shown to be better.
    """
    tiers, begin = list[int](), 0
    for place in range(count):
        if any((above, place) in apart for above in range(begin, place)):
            begin = place
        tiers.append((tiers[-1] + (begin == place)) if tiers else 1)
    return tiers


def _success(result: EvaluationResult, keys: Sequence[tuple[str, int]]) -> Estimate:
    """Return the mean success over tasks in some episodes, (task, start)."""
    starts: dict[str, list[int]] = {}
    for task, start in keys:
        starts.setdefault(task, []).append(start)
    parts = [task.of_starts(starts[task.task]) for task in result.tasks if task.task in starts]
    return overall(parts, stopped=result.stopped is not None)


def _standing(group: Group, tier: int, success: Estimate, ran: Mapping[str, Collection[str]]) -> Standing:
    (result,) = group.results
    return Standing(
        label=group.label,
        tier=tier,
        success=success,
        suites=result.suites,
        parts={name: len(tasks) for name, tasks in result.by_suite.items() if len(tasks) < len(ran[name])},
        episodes=sum(len(task.successes) for task in result.tasks),
        finished=str(result.times.get("finished", ""))[:10],
        paths=group.paths,
    )


def render_board(board: Board) -> str:
    """Return the board as plain text for a terminal."""
    several = board.suites if len(board.suites) > 1 else {}
    heads = [*(["all"] if several else board.suites.values()), "95 %", *several.values(), "episodes"]
    rows = [["tier", "policy", *heads]]
    for row in board.rows:
        cells = [_of_suite(row, suite) for suite in several]
        success = [percent(row.success.value), interval_text(row.success)]
        rows.append([str(row.tier), row.label, *success, *cells, str(row.episodes)])
    notes = [*board.notes, *([TIERS] if len({row.tier for row in board.rows}) > 1 else [])]
    if any(row.episodes != board.shared for row in board.rows):
        of_suites = ", those of suites of all of its own" if several else ""
        notes.append(f"success is that in the {board.shared} episodes that all ran{of_suites}")
    return "\n".join([str(Table(rows[0], rows[1:], 2)), *(f"note: {note}" for note in notes)])


def _of_suite(row: Standing, suite: str) -> str:
    """Return a policy's success on a suite in percent, with the number of its tasks where others ran more."""
    if suite not in row.suites:
        return "–"
    part = f" ({counted(row.parts[suite], 'task')})" if suite in row.parts else ""
    return percent(row.suites[suite].value) + part


def write_board(board: Board, entries: Sequence[Group], path: Path) -> Path:
    """Write the page; it needs no other file and no network.

    Args:
        board: The board.
        entries: The results that it was made of.
        path: File of the page, or a folder for `board.html`.

    Raises:
        ResultsError: The page cannot be written.
    """
    path = path / "board.html" if path.is_dir() or not path.suffix else path
    results = {entry.paths[0]: entry.results[0] for entry in entries}
    return save_page(
        path,
        "libero_eval.judging",
        "board.html",
        title=f"{counted(len(board.rows), 'policy')} on {', '.join(board.suites.values())}",
        facts=[fact for fact in facts(entries[0].results[0]) if fact[0] not in OF_ONE],
        notes=board.notes,
        board=board,
        commands=[[again(results[file], os.path.relpath(file)) for file in row.paths] for row in board.rows],
        alpha=board.alpha,
        of_suite=_of_suite,
        tiers=TIERS,
        interval_text=interval_text,
        p_text=p_text,
    )
