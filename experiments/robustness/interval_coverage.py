"""Coverage of the intervals of `libero_eval.robustness.results`, and false positives of its test, by simulation.

    python experiments/robustness/interval_coverage.py --simulations 400

Ten tasks with ten starts each, as by default. A start has a difficulty of its own, the same in all conditions: the
logit of its success is task + start - loss · severity, with standard deviations of 1.5 between tasks and 1 between
starts.
"""

import argparse

import numpy as np

from libero_eval.robustness.results import Condition, Outcomes

SEVERITIES = (0.2, 0.4, 0.6, 0.8, 1.0)
TASKS = STARTS = 10
CONDITIONS: tuple[Condition, ...] = (
    (),
    *((("a", s),) for s in SEVERITIES),
    *((("b", s),) for s in SEVERITIES),
    (("a", 0.6), ("b", 0.6)),
)


def chances(loss: float, base: float, rng: np.random.Generator, tasks: np.ndarray, starts: int) -> np.ndarray:
    """Return (C, T, S) probabilities of success; kind `a` takes `loss` at severity 1, `b` nothing."""
    difficulty = tasks[:, None] + rng.normal(scale=1.0, size=(TASKS, starts)) + base
    shift = np.array([loss * dict(c).get("a", 0.0) for c in CONDITIONS])
    return 1 / (1 + np.exp(-(difficulty[None] - shift[:, None, None])))


def truth(loss: float, base: float, tasks: np.ndarray) -> dict[str, float]:
    """Return area, kept and excess over all starts there could be."""
    rates = chances(loss, base, np.random.default_rng(0), tasks, 20_000).mean((1, 2))
    places = np.array((0.0, *SEVERITIES))
    line = rates[:6]
    area = float(np.trapezoid(line, places))
    return {"area": area, "kept": area / rates[0], "excess": rates[11] - rates[3] * rates[8] / rates[0]}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simulations", type=int, default=400)
    args = parser.parse_args()
    print("| success | lost | area | kept | excess | no effect, p ≤ .05 |")
    print("|---:|---:|---:|---:|---:|---:|")
    tasks = np.random.default_rng(1).normal(scale=1.5, size=TASKS)
    for base, loss in ((2.5, 1.0), (2.5, 4.0), (0.0, 2.0), (5.0, 2.0)):
        known = truth(loss, base, tasks)
        covered: dict[str, list[bool]] = {name: [] for name in known}
        false = []
        for number in range(args.simulations):
            rng = np.random.default_rng([2, number])
            p = chances(loss, base, rng, tasks, STARTS)
            outcomes = Outcomes(
                tuple(map(str, range(TASKS))),
                tuple(range(STARTS)),
                CONDITIONS,
                rng.random(p.shape) < p,
            )
            axes = {axis.kind: axis for axis in outcomes.axes}
            found = {
                "area": axes["a"].area,
                "kept": axes["a"].kept,
                "excess": outcomes.interactions[0].excess,
            }
            for name, e in found.items():
                covered[name].append(e.low <= known[name] <= e.high)
            false.append(axes["b"].p_value <= 0.05)
        success = chances(loss, base, np.random.default_rng(0), tasks, 20_000).mean((1, 2))
        cells = [f"{100 * np.mean(hits):.1f} %" for hits in covered.values()]
        lost = 1 - success[5] / success[0]
        print(
            f"| {success[0]:.2f} | {100 * lost:.0f} % | {' | '.join(cells)} | {100 * np.mean(false):.1f} % |",
            flush=True,
        )


if __name__ == "__main__":
    main()
