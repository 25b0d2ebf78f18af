"""Coverage of the intervals of `libero report`, and false differences and equivalences, on simulated runs.

    python experiments/comparisons/simulate.py --simulations 1000     # the tables of the README; 20 minutes on one core

An episode succeeds where a normal variable exceeds a threshold (probit), so that the expected success is known exactly:
a mean for every method, row and task, plus effects of the seed (shared by all methods), of the run, of the run on a
task, of what the run forgets, in all and in each cell, and of the start, which is the same in every row, run and
method.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from lifelong.stats.methods import MethodRun, mean_over_seeds, statistics
from lifelong.stats.metrics import METRIC_NAMES, METRIC_RANGES, Curve, Scores, metric_values

TASKS, STARTS, POINTS, CURVE_STARTS = 10, 20, 6, 5
SEED, RUN, RUN_TASK, START = 0.05, 0.22, 0.4, 1.0  # standard deviations, probit scale
LATER, RUN_CELL = 0.25, 0.3  # of a run in all rows after a task's own; of each of its cells
SEEDS = (3, 5, 10)


@dataclass(frozen=True)
class Method:
    """An algorithm: success just after learning, share of it left after each further task, spread of its runs."""

    learned: float = 0.75
    kept: float = 1.0
    frozen: bool = False  # its rollouts repeat down every column
    spread: float = 1.0  # of its runs, in units of `RUN`

    def success(self) -> np.ndarray:
        """(tasks, rows) expected success."""
        rows, cols = np.indices((TASKS, TASKS))
        return (self.learned * self.kept ** np.maximum(rows - cols, 0)).T

    def curve(self) -> np.ndarray:
        return self.learned * (1 - np.exp(-3 * np.arange(POINTS) / (POINTS - 1)))

    def truth(self) -> dict[str, float]:
        """The expected value of every metric."""
        return metric_values(scores(self.success(), np.broadcast_to(self.curve(), (TASKS, POINTS))))


METHODS = {
    "forgets": Method(0.75, 0.6),
    "replays": Method(0.75, 0.95),
    "frozen": Method(frozen=True),
    "near 100 %": Method(0.97, 0.99),
}


def scores(rates: np.ndarray, curves: np.ndarray) -> Scores:
    """Scores from (tasks, rows) rates of the matrix and (tasks, points) rates of the curves."""
    count = np.full(POINTS, CURVE_STARTS)
    lower = np.tri(TASKS, dtype=bool)
    points = tuple(Curve(np.arange(POINTS), curve, count) for curve in curves)
    return Scores(points, np.where(lower, rates.T, np.nan), lower * STARTS, transfer="plain")


def simulate(methods: Sequence[Method], seeds: int, rng: np.random.Generator) -> list[list[MethodRun]]:
    """One experiment with all methods, on the same seeds and starts."""
    shared = SEED * rng.standard_normal((seeds, 1, 1, 1))
    hard = START * rng.standard_normal((1, TASKS, 1, STARTS))
    curve_hard = START * rng.standard_normal((1, TASKS, 1, CURVE_STARTS))
    after = np.tri(TASKS, k=-1).T[None, :, :, None]  # (1, tasks, rows, 1)
    found = []
    for method in methods:
        run, task, later, cell = (method.spread * sd for sd in (RUN, RUN_TASK, LATER, RUN_CELL))
        of_run = run * rng.standard_normal((seeds, 1, 1, 1)) + shared
        of_run = of_run + task * rng.standard_normal((seeds, TASKS, 1, 1))
        total = np.sqrt(1 + SEED**2 + run**2 + task**2 + START**2)
        rows = 1 if method.frozen else TASKS
        noise = rng.standard_normal((seeds, TASKS, rows, STARTS))
        if method.frozen:
            level = ndtri(method.learned) * total
        else:
            forgetting = later * rng.standard_normal((seeds, 1, 1, 1))
            forgetting = forgetting + cell * rng.standard_normal((seeds, TASKS, TASKS, 1))
            noise = noise + after * forgetting
            wide = np.sqrt(total**2 + after * (later**2 + cell**2))
            level = ndtri(np.clip(method.success(), 1e-6, 1 - 1e-6))[None, :, :, None] * wide
        won = np.broadcast_to(level + of_run + hard + noise > 0, (seeds, TASKS, TASKS, STARTS))
        level = ndtri(np.clip(method.curve(), 1e-6, 1 - 1e-6))[None, None, :, None] * total
        noise = rng.standard_normal((seeds, TASKS, POINTS, CURVE_STARTS))
        curves = level + of_run + curve_hard + noise > 0
        found.append([MethodRun(scores(won[s].mean(-1), curves[s].mean(-1)), s) for s in range(seeds)])
    return found


def coverage(seeds: int, simulations: int, rng: np.random.Generator) -> dict[str, list[str]]:
    """Share of intervals that hold the truth, and their mean width, of every method and metric."""
    truths = [method.truth() for method in METHODS.values()]
    inside, width = np.zeros((2, len(METHODS), len(METRIC_NAMES)))
    for _ in range(simulations):
        for i, runs in enumerate(simulate(list(METHODS.values()), seeds, rng)):
            values = [metric_values(run.scores) for run in runs]
            for j, name in enumerate(METRIC_NAMES):
                episodes = sum(run.scores.episodes_of(name) for run in runs)
                e = mean_over_seeds(np.array([v[name] for v in values]), episodes, METRIC_RANGES[name])
                inside[i, j] += e.low - 1e-9 <= truths[i][name] <= e.high + 1e-9
                width[i, j] += e.high - e.low
    shares = zip(METHODS, 100 * inside / simulations, width / simulations, strict=True)
    return {name: [f"{p:.1f} ({w:.2f})" for p, w in zip(a, b, strict=True)] for name, a, b in shares}


def false_differences(
    methods: Sequence[Method], seeds: int, simulations: int, rng: np.random.Generator
) -> list[str]:
    """Of equal methods, each against the first: share of pairs with p < 0.05, and of families with any after Holm."""
    pairs, families = np.zeros((2, len(METRIC_NAMES)))
    for _ in range(simulations):
        runs = simulate(methods, seeds, rng)
        found = statistics({str(i): r for i, r in enumerate(runs)}, ["0"])["differences"]
        for j, name in enumerate(METRIC_NAMES):
            pairs[j] += np.mean([d["metrics"][name]["p_value"] < 0.05 for d in found])
            families[j] += any(d["metrics"][name]["significant"] for d in found)
    return [
        f"{100 * p / simulations:.1f} / {100 * f / simulations:.1f}"
        for p, f in zip(pairs, families, strict=True)
    ]


def pair(first: Method, second: Method, seeds: int, simulations: int, rng: np.random.Generator) -> list[str]:
    """AUC of two methods: true difference, share of experiments that show it, equivalence with it as the margin."""
    gap = first.truth()["auc"] - second.truth()["auc"]
    shown = equivalent = 0
    for _ in range(simulations):
        runs = dict(zip("ab", simulate([first, second], seeds, rng), strict=True))
        auc = statistics(runs, margin=abs(gap))["differences"][0]["metrics"]["auc"]
        shown, equivalent = shown + auc["significant"], equivalent + auc["equivalent"]
    return [f"{gap:.3f}", f"{100 * shown / simulations:.0f} %", f"{100 * equivalent / simulations:.1f} %"]


def show(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    lines = ["| " + " | ".join(row) + " |" for row in (heads, *rows)]
    print("\n".join([lines[0], "|---|" + "---:|" * (len(heads) - 1), *lines[1:]]), "\n", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2026)
    args = parser.parse_args()
    rng, simulations = np.random.default_rng(args.seed), args.simulations
    names = ["FWT", "NBT", "AUC", "final", "just learned"]
    rows = [
        [f"{n} seeds", name, *cells] for n in SEEDS for name, cells in coverage(n, simulations, rng).items()
    ]
    show(["coverage", "method", *names], rows)
    equal = [Method(0.7, 0.95)] * 8
    families = {
        "2 methods": equal[:2],
        "8 methods": equal,
        "8, the first with 3 times the spread": [replace(equal[0], spread=3.0), *equal[1:]],
        "8, the last with 3 times the spread": [*equal[1:], replace(equal[0], spread=3.0)],
    }
    rows = []
    for name, methods in families.items():
        some = simulations if len(methods) == 2 else simulations // 2
        rows += [[f"{name}, {n} seeds", *false_differences(methods, n, some, rng)] for n in SEEDS]
    show(["equal methods", *names], rows)
    rows = []
    for kept in (0.93, 0.9, 0.85):
        for n in SEEDS:
            rows.append([f"{n} seeds", *pair(Method(0.75, 0.95), Method(0.75, kept), n, simulations, rng)])
    show(["AUC of two methods", "difference", "shown", "false equivalence"], rows)


if __name__ == "__main__":
    main()
