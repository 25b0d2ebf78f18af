"""Coverage of the intervals and false differences of the tests, on simulated experiments.

python experiments/comparisons/interval_coverage.py --simulations 2000          # prints the tables of the README
"""

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from model import Design, Method, Outcomes, samples_of, simulate, truths, with_spread

from lifelong.results import components
from lifelong.results.components import interval, p_values
from lifelong.results.contrasts import Contrast, contrasts
from lifelong.results.scores import METRIC_NAMES, METRIC_RANGES, matrix_weights

METHODS = {
    "forgets": Method(0.75, 0.6),
    "replays": Method(0.75, 0.95),
    "frozen": Method(0.7, frozen=True),
    "near 100 %": Method(0.95, 0.99),
}


def coverage(
    design: Design, simulations: int, rng: np.random.Generator, methods: Mapping[str, Method] = METHODS
) -> dict[str, dict[str, list[float]]]:
    """Share of simulations whose 95 % interval holds the truth, and mean width; by method and metric."""
    hits = {n: {m: [0.0, 0.0] for m in METRIC_NAMES} for n in methods}
    for _ in range(simulations):
        for name, outcomes in zip(methods, simulate(list(methods.values()), design, rng), strict=True):
            truth = truths(methods[name], design)
            for metric, sample in samples_of(outcomes, design).items():
                found = interval(sample, METRIC_RANGES[metric])
                hits[name][metric][0] += found.low - 1e-9 <= truth[metric] <= found.high + 1e-9
                hits[name][metric][1] += found.high - found.low
    return {n: {m: [v / simulations for v in pair] for m, pair in rows.items()} for n, rows in hits.items()}


def coverage_of_single_runs(
    design: Design, simulations: int, rng: np.random.Generator
) -> dict[str, dict[str, list[float]]]:
    """The same of single runs, which are given: only their starts are drawn."""
    fixed = {name: replace(method, spread=0.0) for name, method in METHODS.items()}
    return coverage(replace(design, seeds=1, shared=0.0), simulations, rng, fixed)


def percentiles(outcomes: Outcomes, metric: str, design: Design, rng: np.random.Generator) -> np.ndarray:
    """What this replaces: percentiles of means of resampled seeds, with every cell's episodes drawn independently."""
    weights, draws = matrix_weights(design.tasks)[metric].T, 400
    rates = outcomes.matrix.mean(-1)[:, weights != 0]  # (seeds, cells)
    centre = (rates * design.starts + 1.92) / (design.starts + 3.84)
    picked = rng.integers(design.seeds, size=(draws, design.seeds))
    drawn = rng.binomial(design.starts, centre[picked]) / design.starts - centre[picked] + rates[picked]
    return np.quantile((drawn @ weights[weights != 0]).mean(1), [0.025, 0.975])


def coverage_before(design: Design, simulations: int, rng: np.random.Generator) -> dict[str, float]:
    """Coverage of the percentile bootstrap for the metrics that need no learning curve, and of a frozen method."""
    hits = dict.fromkeys(("final_success", "nbt", "just_learned"), 0.0)
    for _ in range(simulations):
        outcomes = simulate([METHODS["replays"]], design, rng)[0]
        for metric in hits:
            low, high = percentiles(outcomes, metric, design, rng)
            hits[metric] += low <= truths(METHODS["replays"], design)[metric] <= high
    return {metric: count / simulations for metric, count in hits.items()}


def false_differences(
    methods: Sequence[Method],
    design: Design,
    simulations: int,
    rng: np.random.Generator,
    spreads: Sequence[float] = (),
) -> dict[str, tuple[float, float]]:
    """Share of pairs of equal methods with p < 0.05, and of simulations with any pair so after Holm; by metric.

    The methods' spreads between runs are those given, or drawn anew in each simulation.
    """
    single, family = dict.fromkeys(METRIC_NAMES, 0.0), dict.fromkeys(METRIC_NAMES, 0.0)
    for _ in range(simulations):
        fixed = [replace(m, spread=s) for m, s in zip(methods, spreads, strict=False)]
        spread = fixed or [with_spread(m, rng) for m in methods]
        found = [samples_of(outcomes, design) for outcomes in simulate(spread, design, rng)]
        for metric in METRIC_NAMES:
            pairs = contrasts({str(i): row[metric] for i, row in enumerate(found)})
            single[metric] += float(np.mean([p.p_value < 0.05 for p in pairs]))
            family[metric] += any(p.adjusted < 0.05 for p in pairs)
    return {m: (single[m] / simulations, family[m] / simulations) for m in METRIC_NAMES}


def false_by_power(
    powers: Sequence[float], design: Design, simulations: int, rng: np.random.Generator
) -> list[dict[str, float]]:
    """Share of simulations in which two equal methods differ, if the runs' share is taken to each of the powers."""
    found: dict[str, list[Contrast]] = {metric: [] for metric in METRIC_NAMES}
    for _ in range(simulations):
        methods = [with_spread(m, rng) for m in equal_methods(2)]
        both = [samples_of(outcomes, design) for outcomes in simulate(methods, design, rng)]
        for metric, pairs in found.items():
            pairs += contrasts({str(i): row[metric] for i, row in enumerate(both)})
    rates, chosen = [], components.TEST_POWER
    degrees = design.seeds - 1  # by which the constant is divided
    for power in powers:
        components.TEST_POWER = power * degrees
        p = {m: p_values([c.estimate.value for c in cs], [c.parts for c in cs]) for m, cs in found.items()}
        rates.append({metric: float(np.mean(values < 0.05)) for metric, values in p.items()})
    components.TEST_POWER = chosen
    return rates


def equal_methods(count: int) -> list[Method]:
    """Methods that keep everything and succeed alike; every second repeats its rollouts."""
    return [Method(0.7, 1.0, frozen=bool(i % 2)) for i in range(count)]


# Spreads between runs, of which one or a few are far above the others', as clare's and mlr's are in the study.
UNEQUAL = {
    "one of 8 has 5 times the spread": [5.0] + [1.0] * 7,
    "as in the study": [5, 2, 2] + [1] * 5 + [0.5] * 6,
}


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield "| " + " | ".join(heads) + " |"
    yield "|---|" + "---:|" * (len(heads) - 1)
    yield from ("| " + " | ".join(row) + " |" for row in rows)


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=2023)
    parser.add_argument(
        "--part", choices=("coverage", "before", "pairs", "power", "unequal", "all"), default="all"
    )
    args = parser.parse_args()
    rng, began = np.random.default_rng(args.seed), time.perf_counter()
    seeds = (2, 3, 5)
    if args.part in ("coverage", "all"):
        rows = []
        for count in (1, *seeds):
            measure = coverage if count > 1 else coverage_of_single_runs
            for tasks in (5, 10):
                for starts in (10, 20):
                    found = measure(Design(tasks, starts, count), args.simulations, rng)
                    for name, metrics in found.items():
                        cells = [f"{percent(metrics[m][0])} ({metrics[m][1]:.2f})" for m in METRIC_NAMES]
                        rows.append([f"{count} seeds, {tasks} tasks, {starts} starts", name, *cells])
                        print("|", " | ".join(rows[-1]), "|", flush=True)
        print(*table(["experiment", "method", *METRIC_NAMES], rows), sep="\n")
    if args.part in ("before", "all"):
        rows = []
        for count in seeds:
            found = coverage_before(Design(10, 20, count), args.simulations // 4, rng)
            rows.append([f"{count} seeds", *(percent(v) for v in found.values())])
        print(*table(["before", *found], rows), sep="\n")
    if args.part in ("unequal", "all"):
        rows = []
        for name, unequal in UNEQUAL.items():
            for count in seeds:
                design, methods = Design(10, 20, count), [Method(0.7, 1.0)] * len(unequal)
                found = false_differences(methods, design, args.simulations // 10, rng, unequal)
                cells = [f"{percent(found[m][0])} / {percent(found[m][1])}" for m in METRIC_NAMES]
                rows.append([f"{name}, {count} seeds", *cells])
                print("|", " | ".join(rows[-1]), "|", flush=True)
        print(*table(["equal methods: pairs / family", *METRIC_NAMES], rows), sep="\n")
    if args.part in ("power", "all"):
        rows = []
        for count in seeds:
            powers = [1, 0.75, 0.5, 0.25, components.TEST_POWER / (count - 1)]
            for power, shares in zip(
                powers, false_by_power(powers, Design(10, 20, count), 4 * args.simulations, rng), strict=True
            ):
                rows.append([f"{count} seeds", f"{power:.3g}", *(percent(shares[m]) for m in METRIC_NAMES)])
                print("|", " | ".join(rows[-1]), "|", flush=True)
        print(*table(["two equal methods", "power of the share", *METRIC_NAMES], rows), sep="\n")
    if args.part in ("pairs", "all"):
        rows = []
        for methods, times in {2: 4, 3: 1, 13: 1 / 4, 21: 1 / 16}.items():
            for count in seeds:
                some = int(args.simulations * times)
                found = false_differences(equal_methods(methods), Design(10, 20, count), some, rng)
                cells = [f"{percent(found[m][0])} / {percent(found[m][1])}" for m in METRIC_NAMES]
                rows.append([f"{methods} methods, {count} seeds", str(some), *cells])
                print("|", " | ".join(rows[-1]), "|", flush=True)
        print(*table(["equal methods: pairs / family", "simulations", *METRIC_NAMES], rows), sep="\n")
    print(f"{(time.perf_counter() - began) / 60:.0f} minutes")


if __name__ == "__main__":
    main()
