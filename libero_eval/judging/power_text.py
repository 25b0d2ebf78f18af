"""Answers of `libero power` as plain text."""

import math
from dataclasses import replace

from libero_env.text import Table
from libero_eval.stats.power import (
    Question,
    paired_episodes,
    sequential_stopping,
    shown_difference,
    unpaired_episodes,
)
from lifelong.errors import ConfigError

DIFFERENCES = (0.01, 0.02, 0.03, 0.05, 0.10)
DISCORDANCES = (0.05, 0.10, 0.20)
SIMULATED = 20_000  # pairs up to which the sequential test is simulated


def answer(question: Question) -> str:
    """Say how many episodes a difference needs: in the same starts, in others, and with a test that stops early."""
    paired, unpaired = paired_episodes(question), unpaired_episodes(question)
    lines = [
        f"success {100 * question.base:.1f} % and {100 * question.other:.1f} %, "
        f"power {100 * question.power:.0f} %, alpha {question.alpha:g}{_tests(question)}",
        f"same starts (McNemar, exact; {100 * question.differing:.1f} % of the pairs differ"
        f"{'' if question.discordance is not None else ', as independent outcomes do'}): "
        f"{paired} episodes of each policy",
        f"different starts (two proportions): {unpaired} episodes of each policy",
    ]
    if 2 * paired <= SIMULATED:
        stopping = sequential_stopping(question, 2 * paired)
        half = f"half of the evaluations stop by {stopping.median:.0f} pairs, " if stopping.median > 0 else ""
        lines.append(
            f"same starts, stopped as soon as it is decided: {half}"
            f"{100 * stopping.power:.0f} % are decided by {stopping.limit}"
        )
    return "\n".join(lines)


def shown(question: Question, episodes: int, **outcomes: float | None) -> str:
    """Say which difference a number of episodes of each policy in the same starts shows.

    Args:
        outcomes: How the outcomes of a pair go together, see `shown_difference`.
    """
    ways = {"worse": -question.base / 1000, "better": (1 - question.base) / 1000}
    sizes = {
        name: shown_difference(replace(question, difference=gap), episodes, **outcomes)
        for name, gap in ways.items()
    }
    head = (
        f"{episodes} pairs, success {100 * question.base:.1f} %, power {100 * question.power:.0f} %, alpha "
        f"{question.alpha:g}{_tests(question)}: shown are"
    )
    found = [
        f"  {name} by {100 * size:.1f} points"
        if math.isfinite(size)
        else f"  {name}: no difference that is possible"
        for name, size in sizes.items()
    ]
    return "\n".join([head, *found])


def table(question: Question) -> str:
    """Return a table: episodes of each policy by difference and by the share of pairs that differ."""
    rows = [["difference", *(f"{100 * d:.0f} % differ" for d in DISCORDANCES), "independent", "other starts"]]
    for size in DIFFERENCES:
        gap = size if question.base + size <= 1 else -size
        name = f"{100 * gap:+.0f} points".replace("-", "−")
        paired = [_episodes(question, gap, share) for share in (*DISCORDANCES, None)]
        rows.append([name, *paired, str(unpaired_episodes(replace(question, difference=gap)))])
    return (
        f"episodes of each policy, success {100 * question.base:g} %, power {100 * question.power:.0f} %, "
        f"alpha {question.alpha:g}{_tests(question)}\n"
        "in the same starts, by the share of starts in which exactly one of the two succeeds; in other starts\n\n"
        f"{Table(rows[0], rows[1:], 0)}\n\n"
        "a suite of ten tasks has 500 starts, four suites have 2000; --difference and --discordance ask for one case"
    )


def _episodes(question: Question, gap: float, share: float | None) -> str:
    try:
        return str(paired_episodes(replace(question, difference=gap, discordance=share)))
    except ConfigError:  # with these rates, so many pairs cannot differ
        return "–"


def _tests(question: Question) -> str:
    return f" over {question.tests} comparisons" if question.tests > 1 else ""
