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
    unknown = dict.fromkeys(("value", "low", "high", "p_value", "adjusted", "shown"), float("nan"))
    return [
        {
            "of": a,
            "less": b,
            "metrics": {
                name: table.get((a, b), {**unknown, "told_apart": False, "paired_seeds": 0, "seeds": None})
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
            "told_apart": pair.adjusted < ALPHA,
            "paired_seeds": pair.pairs,
            "shown": ahead.shown,
            "seeds": ahead.seeds,
        }
    return found


def findings(found: Mapping[str, Any], names: Mapping[str, str], most: int = 12) -> list[str]:
    """Return in sentences what a comparison shows and what it does not, and how many seeds would tell.

    Args:
        found: Result of `statistics`, or of `lifelong.report.comparison.compare`.
        names: Metrics to name, and how.
        most: Number of pairs that are named; of further ones, their number.
    """
    lines = []
    for metric, name in names.items():
        pairs = [(d["of"], d["less"], d["metrics"][metric]) for d in found["differences"]]
        pairs = [(a, b, m) for a, b, m in pairs if _known(m["value"])]
        open_ = sorted((p for p in pairs if not p[2]["told_apart"]), key=lambda p: p[2]["p_value"])
        if not pairs:
            continue
        text = f"{name}: {len(pairs) - len(open_)} of {len(pairs)} pairs are told apart"
        named = [f"{a} and {b} ({_outlook(m)})" for a, b, m in open_[:most]]
        rest = f", and {len(open_) - most} more" if len(open_) > most else ""
        alone = ". A second seed would say how far seeds differ" if any(map(_of_one_seed, open_)) else ""
        lines.append(text + (f". Not: {', '.join(named)}{rest}{alone}." if named else "."))
    return lines


def _of_one_seed(pair: tuple[str, str, Mapping[str, Any]]) -> bool:
    return not _known(pair[2]["shown"])


def _known(value: float | None) -> bool:
    """Return whether a number is known; JSON has null where it is not."""
    return value is not None and bool(np.isfinite(value))


def _outlook(metric: Mapping[str, Any]) -> str:
    """Return what a pair that is not told apart differs by and, from several seeds, how many would tell."""
    value = f"{100 * metric['value']:+.1f}"
    if not _known(metric["shown"]):
        return value
    seeds = metric["seeds"] or f"more than {MOST_SEEDS}"
    return f"{value}; {seeds} seeds would tell, these show {100 * metric['shown']:.0f}"
