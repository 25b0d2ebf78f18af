"""What several runs of several methods show: means with intervals, corrected differences, seeds to add."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lifelong.results.components import Sample, components, interval
from lifelong.results.contrasts import Contrast, contrasts
from lifelong.results.curves import Transfer
from lifelong.results.intervals import Estimate
from lifelong.results.metrics import mean_and_standard_error
from lifelong.results.samples import Member, samples
from lifelong.results.scores import METRIC_NAMES, METRIC_RANGES
from lifelong.results.seeds import ALPHA, MOST_SEEDS, POWER, outlook

CONFIDENCE = 0.95
METHOD = {
    "confidence": CONFIDENCE,
    "levels": ["order or seed", "start of a task"],
    "interval": "variance components of runs and starts, Cochran and Cox",
    "tests": "paired by seed and start, spread between seeds partly pooled over the methods",
    "correction": "Holm, over all pairs in one metric",
    "alpha": ALPHA,
    "power": POWER,
    "most_seeds": MOST_SEEDS,
}


def statistics(groups: Mapping[str, Sequence[Member]]) -> dict[str, Any]:
    """Return the metrics of every group and the differences of every pair, as plain data; NaN where one is unknown.

    Args:
        groups: Runs of each method; at least one in each.
    """
    found = samples(comparable(groups))
    return {
        "metrics": {label: {n: _metric(n, found[n][label]) for n in METRIC_NAMES} for label in groups},
        "differences": _differences(found, list(groups)),
        "statistics": METHOD,
    }


def comparable(groups: Mapping[str, Sequence[Member]]) -> dict[str, list[Member]]:
    """Return the runs with one kind of estimate of forward transfer: eq. 3 as published only if all of them use it."""
    kinds = {m.scores.transfer for members in groups.values() for m in members}
    if kinds == {"published"}:
        return {label: list(members) for label, members in groups.items()}
    instead: Mapping[Transfer, Transfer] = {"published": "cross_fitted"}
    return {
        label: [
            replace(m, scores=replace(m.scores, transfer=instead.get(m.scores.transfer, m.scores.transfer)))
            for m in members
        ]
        for label, members in groups.items()
    }


def _metric(name: str, sample: Sample) -> dict[str, Any]:
    estimate = interval(sample, METRIC_RANGES[name], CONFIDENCE)
    _, error = mean_and_standard_error(sample.values)
    parts, runs = components(sample), len(sample.values)
    return {
        "mean": estimate.value,
        "standard_error": error,
        "low": estimate.low,
        "high": estimate.high,
        "values": sample.values.tolist(),
        "sd_of_runs": float(np.sqrt(parts.runs * runs)) if runs > 1 else float("nan"),
        "sd_of_starts": float(np.sqrt(parts.starts)),
    }


def _differences(found: Mapping[str, Mapping[str, Sample]], labels: Sequence[str]) -> list[dict[str, Any]]:
    tables = {name: _of_metric(name, contrasts(found[name])) for name in METRIC_NAMES}
    unknown = dict.fromkeys(("value", "low", "high", "p_value", "adjusted", "detectable"), float("nan"))
    return [
        {
            "of": a,
            "less": b,
            "metrics": {
                name: table.get((a, b), {**unknown, "significant": False, "paired_seeds": 0, "seeds": None})
                for name, table in tables.items()
            },
        }
        for i, a in enumerate(labels)
        for b in labels[i + 1 :]
    ]


def _of_metric(name: str, pairs: Sequence[Contrast]) -> dict[tuple[str, str], dict[str, Any]]:
    low, high = METRIC_RANGES[name]
    found = {}
    for pair in pairs:
        ahead = outlook(pair, len(pairs))
        inside = Estimate(
            pair.estimate.value, max(pair.estimate.low, low - high), min(pair.estimate.high, high - low)
        )
        found[pair.first, pair.second] = {
            "value": inside.value,
            "low": inside.low,
            "high": inside.high,
            "p_value": pair.p_value,
            "adjusted": pair.adjusted,
            "significant": pair.adjusted < ALPHA,
            "paired_seeds": pair.pairs,
            "detectable": ahead.detectable,
            "seeds": ahead.seeds,
        }
    return found


def findings(found: Mapping[str, Any], names: Mapping[str, str], most: int = 12) -> list[str]:
    """Return in sentences how many pairs differ significantly, and how many seeds the others would need.

    Args:
        found: Result of `statistics`, or of `lifelong.report.comparison.compare`.
        names: Metrics to name, and how.
        most: Number of pairs that are named; of further ones, their number.
    """
    lines = []
    for metric, name in names.items():
        pairs = [(d["of"], d["less"], d["metrics"][metric]) for d in found["differences"]]
        pairs = [(a, b, m) for a, b, m in pairs if _known(m["value"])]
        tested = [p for p in pairs if _known(p[2]["adjusted"])]
        open_ = sorted((p for p in tested if not p[2]["significant"]), key=lambda p: p[2]["p_value"])
        if not pairs:
            continue
        text = f"{name}: {len(tested) - len(open_)} of {len(pairs)} pairs differ significantly."
        named = [f"{a} and {b} ({_outlook(m)})" for a, b, m in open_[:most]]
        rest = f", and {len(open_) - most} more" if len(open_) > most else ""
        text += f" Not: {', '.join(named)}{rest}." if named else ""
        alone = "" if len(tested) == len(pairs) else f" {_UNTESTED[not tested]}"
        lines.append(text + alone)
    return lines


_UNTESTED = {
    True: "None is tested: there is one seed, and only a second one says how far seeds differ.",
    False: "Pairs of methods with one seed each are not tested: only a second one says how far seeds differ.",
}


def _known(value: float | None) -> bool:
    """Return whether a number is known; JSON has null where it is not."""
    return value is not None and bool(np.isfinite(value))


def _outlook(metric: Mapping[str, Any]) -> str:
    """Return the difference of a pair and, from several seeds, how many would show it and what these would."""
    value = f"{100 * metric['value']:+.1f}"
    if not _known(metric["detectable"]):
        return value
    seeds, detectable = metric["seeds"] or f"more than {MOST_SEEDS}", metric["detectable"]
    least = f"detectable {100 * detectable:.0f}" if detectable < 1 else "nothing detectable"
    return f"{value}; {seeds} seeds needed, {least}"
