"""Error rates of the tests and coverage of the intervals of `libero compare`, on simulated evaluations.

    python experiments/judging/simulate.py [--simulations 4000]

Each start has a success probability of its own (Beta), which both policies share if they are equal; given it, episodes
are independent. "Interaction": each policy is better on half of the tasks, and both are equal on average. "Quirks":
each is better in half of the starts, at random.
"""

import argparse
from functools import cache

import numpy as np
from scipy import stats

from libero_eval.stats.episodes import (
    Counts,
    Pairs,
    bootstrap_starts,
    mcnemar_exact,
    score_interval,
    sign_flip_test,
)
from libero_eval.stats.sequential import anytime_interval, log_evidence, rounds, sequential_test, shuffled
from lifelong.stats.intervals import holm, wilson_interval

TASKS = 10


def evaluate(rng, *, rate, spread, starts=50, gap=0.0, interaction=0.0, quirk=0.0, runs=1) -> Pairs:
    """Draw the outcomes of two policies; the first is better by `gap`, in probability, on average over starts."""
    count = TASKS * starts
    hard = rng.beta(rate * spread, (1 - rate) * spread, size=count)
    tasks = np.repeat(np.arange(TASKS), starts)
    shift = np.where(tasks % 2 == 0, interaction, -interaction)
    shift = shift + quirk * rng.choice([-1, 1], size=count)
    chances = [np.clip(hard + sign * (gap + shift) / 2, 0, 1) for sign in (1, -1)]
    columns = [rng.random((count, runs)) < p[:, None] for p in chances]
    return Pairs(tasks, np.tile(np.arange(starts), TASKS), *columns)


def outcome(pairs: Pairs) -> Counts:
    both, first = (pairs.first & pairs.second).sum(), pairs.first.sum()
    second = pairs.second.sum()
    return Counts(int(both), int(first - both), int(second - both), int(len(pairs) - first - second + both))


@cache
def mcnemar(counts: Counts) -> float:
    return mcnemar_exact(counts)


@cache
def interval(counts: Counts):
    return score_interval(counts)


def unpaired(counts: Counts) -> float:
    """The two-proportion z-test of most papers, which ignores that the starts are the same."""
    n = counts.pairs
    first, second = (counts.both + counts.only_first) / n, (counts.both + counts.only_second) / n
    pooled = (first + second) / 2
    spread = np.sqrt(2 * pooled * (1 - pooled) / n)
    return float(2 * stats.norm.sf(abs(first - second) / spread)) if spread else 1.0


def peeking(pairs: Pairs, every: int = 50) -> bool:
    """McNemar's test after every fifty pairs, stopped as soon as it is below 0.05: what must not be done."""
    order = np.lexsort((pairs.tasks, pairs.starts))
    ends = range(every, len(pairs) + 1, every)
    parts = (
        Pairs(*(a[order[:end]] for a in (pairs.tasks, pairs.starts, pairs.first, pairs.second)))
        for end in ends
    )
    return any(mcnemar(outcome(part)) <= 0.05 for part in parts)


def false_positives(rng, simulations: int) -> None:
    print(
        "\n| equal policies | McNemar | unpaired z | looks every 50: McNemar | looks at every pair: sequential |"
    )
    print("|---|---|---|---|---|")
    cases = {
        "90 %, hard starts differ": {"rate": 0.9, "spread": 0.5},
        "90 %, starts alike": {"rate": 0.9, "spread": 50},
        "50 %, hard starts differ": {"rate": 0.5, "spread": 1},
        "97 %, 10 starts": {"rate": 0.97, "spread": 1, "starts": 10},
        "80 %, interaction ± 20 points": {"rate": 0.8, "spread": 5, "interaction": 0.2},
    }
    for name, case in cases.items():
        found = np.zeros(4)
        for _ in range(simulations):
            pairs = evaluate(rng, **case)
            counts = outcome(pairs)
            sequential = sequential_test(pairs).decided_after is not None
            found += (mcnemar(counts) <= 0.05, unpaired(counts) <= 0.05, peeking(pairs), sequential)
        print(f"| {name} | " + " | ".join(f"{100 * f:.1f} %" for f in found / simulations) + " |")


def families(rng, simulations: int) -> None:
    each, adjusted = 0, 0
    for _ in range(simulations):
        p = [mcnemar(outcome(evaluate(rng, rate=0.8, spread=2))) for _ in range(4)]
        each += min(p) <= 0.05
        adjusted += min(holm(p)) <= 0.05
    print("\n| four suites, equal policies: at least one difference | |\n|---|---|")
    print(
        f"| each at 5 % | {100 * each / simulations:.1f} % |\n| Holm | {100 * adjusted / simulations:.1f} % |"
    )


def several_runs(rng, simulations: int) -> None:
    print(
        "\n| three runs of each, equal policies | random swaps of starts | McNemar, each run as a start |"
        "\n|---|---|---|"
    )
    for name, quirk in {"equal in every start": 0.0, "quirks ± 40 points": 0.8}.items():
        flips, pooled = 0, 0
        for _ in range(simulations):
            pairs = evaluate(rng, rate=0.5, spread=5, runs=3, starts=20, quirk=quirk)
            flips += sign_flip_test(pairs.differences, draws=999) <= 0.05
            columns = [x.reshape(-1, 1) for x in (pairs.first, pairs.second)]
            pooled += (
                mcnemar(outcome(Pairs(np.repeat(pairs.tasks, 3), np.repeat(pairs.starts, 3), *columns)))
                <= 0.05
            )
        print(f"| {name} | {100 * flips / simulations:.1f} % | {100 * pooled / simulations:.1f} % |")


def coverage(rng, simulations: int) -> None:
    print(
        "\n| true difference | success | starts | Tango covers | mean width | bootstrap over starts covers |"
    )
    print("|---|---|---|---|---|---|")
    for rate, gap, starts in (
        (0.9, 0.0, 50),
        (0.9, 0.03, 50),
        (0.6, 0.1, 50),
        (0.95, 0.02, 10),
        (0.6, 0.1, 5),
    ):
        case = {"rate": rate, "spread": 2, "gap": gap, "starts": starts}
        truth = np.mean([evaluate(rng, **case, runs=50).differences.mean() for _ in range(300)])
        covered, widths, boot, booted = 0, 0.0, 0, max(1, simulations // 10)
        for number in range(simulations):
            pairs = evaluate(rng, **case)
            e = interval(outcome(pairs))
            covered, widths = covered + (e.low <= truth <= e.high), widths + e.high - e.low
            if number < booted:
                e = bootstrap_starts(pairs, draws=999, seed=number)
                boot += e.low <= truth <= e.high
        print(
            f"| {100 * truth:+.1f} points | {100 * rate:.0f} % | {TASKS} × {starts} | "
            f"{100 * covered / simulations:.1f} % | "
            f"{100 * widths / simulations:.1f} points | {100 * boot / booted:.1f} % |"
        )


def means(rng, simulations: int) -> None:
    """Intervals of the mean over ten tasks: over all episodes, and combined from single tasks' (MOVER)."""
    print(
        "\n| tasks | starts | all episodes: covers | width | combined: covers | width |\n|---|---:|---:|---:|---:|---:|"
    )
    for name, rates in (
        ("all 95 %", np.full(TASKS, 0.95)),
        ("80 to 100 %", np.linspace(0.8, 1, TASKS)),
        ("0 to 100 %", np.linspace(0, 1, TASKS)),
    ):
        for starts in (5, 10, 20, 50):
            won = rng.binomial(starts, rates, (simulations, TASKS))
            low, high = wilson_interval(won, starts)
            spread = [np.sqrt((side**2).sum(1)) / TASKS for side in (won / starts - low, high - won / starts)]
            value = won.mean(1) / starts
            both = wilson_interval(won.sum(1), TASKS * starts), (value - spread[0], value + spread[1])
            covers = [((low <= rates.mean()) & (rates.mean() <= high)).mean() for low, high in both]
            widths = [(high - low).mean() for low, high in both]
            cells = (f"{100 * c:.0f} % | {100 * w:.1f}" for c, w in zip(covers, widths, strict=True))
            print(f"| {name} | {starts} | {' | '.join(cells)} |")


def drift(rng, simulations: int) -> None:
    """Stopping where difficulty drifts with the start's number: in the order of the starts, and as `--until` looks."""
    print("\n| better by, from the first start to the last | order | above | below |\n|---|---|---:|---:|")
    cases = {
        "none": np.zeros(50),
        "+20 to -20 points": np.linspace(0.2, -0.2, 50),
        "+40 to -40 points": np.linspace(0.4, -0.4, 50),
        "+20, in the second half -20 points": np.repeat([0.2, -0.2], 25),
    }
    for name, gap in cases.items():
        for order, looked in (("of the starts", tuple(range(50))), ("of `--until`", shuffled(range(50)))):
            found = np.zeros(2)
            for _ in range(simulations):
                hard = rng.beta(1.4, 0.6, size=(50, TASKS))
                first, second = (
                    rng.random(hard.shape) < np.clip(hard + sign * gap[:, None] / 2, 0, 1) for sign in (1, -1)
                )
                d = (first.astype(int) - second)[list(looked)]
                won, lost = (d > 0).sum(1).cumsum(), (d < 0).sum(1).cumsum()
                known = log_evidence(won, lost) >= np.log(20)
                if known.any():
                    at = int(known.argmax())
                    found += (won[at] > lost[at], won[at] < lost[at])
            above, below = found / simulations
            print(f"| {name} | {order} | {100 * above:.1f} % | {100 * below:.1f} % |")


def stopping(rng, simulations: int) -> None:
    """Stop after the round in which an interval is narrow enough, of at most 50 starts of ten tasks."""
    print(
        "\n| | | always-valid | | Wilson's, looked at after each round | | |\n|---|---:|---:|---:|---:|---:|---:|"
    )
    print(
        "| success | width | covers at the stop | episodes of 500 | covers at the stop | at every look | episodes |"
    )
    counts = TASKS * np.arange(1, 51)
    for name, rate, spread in (("99 %", 0.99, 1e6), ("95 %", 0.95, 1e6), ("90 %, tasks differ", 0.9, 2)):
        for width in (0.05, 0.1, 0.2):
            found = np.zeros((2, 3))  # of each interval
            for _ in range(simulations):
                rates = rng.beta(rate * spread, (1 - rate) * spread, size=TASKS)
                won = (rng.random((50, TASKS)) < rates).sum(1).cumsum()
                for k, (low, high) in enumerate((anytime(won), wilson_interval(won, counts))):
                    covers, narrow = (low <= rates.mean()) & (rates.mean() <= high), high - low < width
                    at = int(narrow.argmax()) if narrow.any() else 49
                    found[k] += (covers[at], covers.all(), counts[at])
            (stop, _, count), (wilson, every, short) = found / simulations
            cells = (
                f"{100 * stop:.1f} % | {count:.0f} | {100 * wilson:.1f} % | {100 * every:.0f} % | {short:.0f}"
            )
            print(f"| {name} | {width} | {cells} |")


@cache
def sequence(won: int, episodes: int):
    return anytime_interval(won, episodes)


def anytime(won):
    ends = [sequence(int(w), TASKS * k) for k, w in enumerate(won, 1)]
    return np.array([e.low for e in ends]), np.array([e.high for e in ends])


def decisions(rng, simulations: int) -> None:
    """Stop when a policy is known to be above or below another one, less a margin."""
    print("\n| other | difference | margin | above | below | pairs of 500 |\n|---|---|---|---|---|---|")
    for rate, gap, margin in (
        (0.9, 0.0, 0.0),
        (0.9, 0.05, 0.0),
        (0.9, 0.1, 0.0),
        (0.9, -0.05, 0.05),
        (0.9, 0.0, 0.05),
        (0.9, -0.1, 0.05),
    ):
        found = np.zeros(3)
        for _ in range(simulations):
            pairs = evaluate(rng, rate=rate, spread=2, gap=gap)
            order = rounds(pairs)
            d = (pairs.first[order, 0].astype(int) - pairs.second[order, 0]).reshape(-1, TASKS)
            won, lost = (d > 0).sum(1).cumsum(), (d < 0).sum(1).cumsum()
            counts = TASKS * np.arange(1, len(d) + 1)
            known = log_evidence(won, lost, counts - won - lost, margin) >= np.log(20)
            at = int(known.argmax()) if known.any() else len(d) - 1
            above = won[at] - lost[at] > -margin * counts[at]
            found += (known.any() and above, known.any() and not above, counts[at])
        above, below, count = found / simulations
        print(
            f"| {100 * rate:.0f} % | {100 * gap:+.0f} points | {margin} | {100 * above:.1f} % | {100 * below:.1f} % | "
            f"{count:.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--simulations", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    false_positives(rng, args.simulations)
    families(rng, args.simulations)
    several_runs(rng, args.simulations // 4)
    coverage(rng, args.simulations)
    means(rng, args.simulations)
    stopping(rng, args.simulations)
    decisions(rng, args.simulations // 4)
    drift(rng, args.simulations)


if __name__ == "__main__":
    main()
