"""Put the numbers of the planned comparison into frontier.md, and draw its figure.

    python experiments/algorithms/frontier.py           # --check: is the page that of the records?

Everything is of the finished runs of `study.py`, whatever their number; plan.md says what is compared.
"""

import argparse
import math
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from reading import by_seed, in_points, results_of, table
from study import CROSSED, FRONTIER, SEEDS, STARTS, Draws, planned

from libero_env.text import quantity
from lifelong.report.figures import LINE_COLOURS, LINE_MARKERS, STYLE, legend_below
from lifelong.results.results import Results
from lifelong.stats.intervals import Estimate, holm
from lifelong.stats.methods import mean_over_seeds, paired_difference
from lifelong.stats.metrics import METRIC_RANGES, metric_values

PAGE = Path(__file__).with_name("frontier.md")
METRICS = {"just_learned": "just learned", "final_success": "final", "nbt": "NBT", "auc": "AUC"}
PAIRS = (
    ("packnet", "compressed_er 2"),
    ("packnet", "compressed_er 10"),
    ("compressed_er 10", "iscil 16"),
    ("compressed_er 10", "lora 16"),
    ("compressed_er 2", "er 2"),
    ("packnet", "er 2"),
    ("iscil 16", "er 2"),
    ("lora 16", "er 2"),
)
STARTED = tuple((f"{a}, {r}", f"{b}, {r}") for r in ("er 0", "er 2") for a, b in
                (("libero_90", "scratch"), ("imagenet", "random")))  # fmt: skip
LEVELS = (1e6, 1e7, 1e8, 1e9)  # bytes, up to which the highest method is named
TOLD = ("packnet", "lora", "single_task")
RUNS = (3, 5, 10)  # numbers of runs whose precision is shown
BOOTSTRAP = 20_000


@dataclass(frozen=True)
class Kept:
    """The finished runs of a method.

    Attributes:
        runs: Results by seeds.
        metrics: Metrics by seeds.
    """

    runs: dict[Draws, Results]
    metrics: dict[Draws, dict[str, float]]

    def estimate(self, name: str) -> Estimate:
        """Return the mean of a metric over seeds."""
        episodes = sum(r.scores().episodes_of(name) for r in self.runs.values())
        values = np.array([found[name] for found in self.metrics.values()])
        return mean_over_seeds(values, episodes, METRIC_RANGES[name])

    def less(self, other: "Kept", name: str) -> np.ndarray:
        """Return the differences of a metric by seeds, of those that both have."""
        both = sorted(self.metrics.keys() & other.metrics.keys())
        return np.array([self.metrics[draws][name] - other.metrics[draws][name] for draws in both])

    def costs(self, name: str, last: bool = False) -> float:
        """Return a cost, mean over seeds and over tasks, or after the last of them."""
        tables = [list(found.costs_by_task().values()) for found in self.runs.values()]
        return fmean(row[name] for rows in tables for row in (rows[-1:] if last else rows))


def kept(study: str, methods: Sequence[str]) -> dict[str, Kept]:
    """Return the finished runs of some methods of a study."""
    found = {}
    for method in methods:
        runs = {run.draws: results for run, results in results_of(study, method)}
        if runs:
            metrics = {draws: metric_values(results.scores()) for draws, results in runs.items()}
            found[method] = Kept(runs, metrics)
    return found


def _cell(found: Estimate) -> str:
    return f"{found.value:z.2f}" + (
        "" if math.isnan(found.low) else f" [{found.low:z.2f}, {found.high:z.2f}]"
    )


def rows(methods: dict[str, Kept]) -> list[str]:
    """What each method keeps, computes and reaches, by bytes."""
    lines = []
    for name, found in sorted(methods.items(), key=lambda item: item[1].costs("stored_bytes", True)):
        operations = found.costs("flops_per_step") * found.costs("updates")
        lines.append(
            [
                name,
                str(len(found.runs)),
                "yes" if name.split()[0] in TOLD else "no",
                quantity(found.costs("stored_bytes", True), "B"),
                f"{found.costs('kept_share', True):.2g} %",
                quantity(operations, "FLOP"),
                *(_cell(found.estimate(metric)) for metric in METRICS),
            ]
        )
    heads = ["method", "seeds", "told the task", "kept", "of all windows", "operations a task"]
    return table([*heads, *METRICS.values()], lines)


def pairs(
    methods: dict[str, Kept], planned_pairs: Sequence[tuple[str, str]], names: Sequence[str]
) -> list[str]:
    """The planned pairs that both have runs, each metric with Holm's p over the family."""
    known = [(methods[a], methods[b], f"{a} − {b}") for a, b in planned_pairs if {a, b} <= methods.keys()]
    lines = [[title] for *_, title in known]
    for name in names:
        found = [paired_difference(a.less(b, name)) for a, b, _ in known]
        for line, one, p in zip(lines, found, holm([one.p_value for one in found]), strict=True):
            line += [in_points(one.estimate), "–" if math.isnan(p) else f"{p:.2g}"]
    for line, (a, b, _) in zip(lines, known, strict=True):
        line.append(by_seed(a.less(b, names[0])))
    heads = ["pair", *(head for name in names for head in (METRICS[name], "p (Holm)"))]
    return table([*heads, f"{METRICS[names[0]]}, each seed"], lines)


def highest(methods: dict[str, Kept]) -> list[str]:
    """Which method with no more than so many bytes ends highest, and by how much above the next."""
    lines = []
    for most in LEVELS:
        fitting = {n: m for n, m in methods.items() if m.costs("stored_bytes", True) <= most}
        order = sorted(fitting, key=lambda n: -fitting[n].estimate("final_success").value)[:2]
        if len(order) == 2:
            gap = paired_difference(fitting[order[0]].less(fitting[order[1]], "final_success")).estimate
            lines.append([f"up to {quantity(most, 'B')}", *order, in_points(gap)])
    return table(["kept", "highest", "next", "less the next"], lines)


def components(values: dict[Draws, float]) -> dict[str, float]:
    """Return the standard deviations of seed, order, demonstrations and the rest, by restricted likelihood."""
    import pandas as pd
    from statsmodels.regression.mixed_linear_model import MixedLM

    data = pd.DataFrame([(*draws, value) for draws, value in values.items()], columns=[*FACTORS, "value"])
    parts = {name: f"0 + C({name})" for name in FACTORS}
    model = MixedLM.from_formula(
        "value ~ 1", data, groups=np.ones(len(data)), vc_formula=parts, re_formula="0"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where a component is 0, the least is on the boundary
        fitted = model.fit(reml=True)
    found = dict(zip(model.exog_vc.names, np.sqrt(fitted.vcomp), strict=True))
    return {name: float(found[name]) for name in FACTORS} | {"rest": float(np.sqrt(fitted.scale))}


FACTORS = ("seed", "order", "data")


def by_mean_squares(values: np.ndarray) -> np.ndarray:
    """Return the same of balanced values (B, seeds, orders, sets), from mean squares, none below 0: (B, 4)."""
    shape, axes = values.shape[1:], (1, 2, 3)
    centred = values - values.mean(axes, keepdims=True)
    main = [centred.mean(tuple(x for x in axes if x != axis), keepdims=True) for axis in axes]
    rest = (centred - sum(main)).reshape(len(values), -1)
    within = (rest**2).sum(1) / (math.prod(shape) - 1 - sum(n - 1 for n in shape))
    others = [math.prod(shape) / n for n in shape]
    squares = [
        m * (one.reshape(len(values), -1) ** 2).sum(1) / (n - 1)
        for m, one, n in zip(others, main, shape, strict=True)
    ]
    variances = [(square - within) / m for square, m in zip(squares, others, strict=True)]
    return np.sqrt(np.maximum(0, np.stack([*variances, within], axis=1)))


def _intervals(found: dict[str, float]) -> dict[str, np.ndarray]:
    """Return a parametric bootstrap's 95 % intervals of the deviations, in the crossed design."""
    rng, shape = np.random.default_rng(0), (2, 3, 3)
    drawn = rng.normal(0, found["rest"], (BOOTSTRAP, *shape))
    for axis, name in enumerate(FACTORS):
        size = [shape[axis] if i == axis else 1 for i in range(3)]
        drawn += rng.normal(0, found[name], (BOOTSTRAP, *size))
    ends = np.quantile(by_mean_squares(drawn), (0.025, 0.975), axis=0)
    return {name: ends[:, i] for i, name in enumerate((*FACTORS, "rest"))}


def seeds(methods: dict[str, Kept]) -> list[str]:
    """Deviations that order, demonstrations and seed of learning each make, and the standard errors that follow."""
    own = {name: {d: m for d, m in found.metrics.items() if d in CROSSED} for name, found in methods.items()}
    lines = []
    cases = [(name, own[name], None) for name in SEEDS.methods] + [
        ("er 2 − sequential", own["er 2"], own["sequential"])
    ]
    for title, metrics, other in cases:
        for name, metric in METRICS.items():
            values = {d: m[name] - (other[d][name] if other else 0.0) for d, m in metrics.items()}
            found = components(values)
            ends = _intervals(found)
            all_three = math.hypot(*found.values())
            lines.append(
                [
                    title,
                    metric,
                    *(
                        f"{100 * found[n]:.1f} [{100 * ends[n][0]:.1f}, {100 * ends[n][1]:.1f}]"
                        for n in found
                    ),
                    *(f"{100 * all_three / math.sqrt(count):.1f}" for count in RUNS),
                    f"{100 * math.hypot(found['seed'], found['rest']) / math.sqrt(3):.1f}",
                ]
            )
    heads = ["", "", "seed", "order", "demonstrations", "rest"]
    errors = [f"standard error of {count} runs, all three drawn" for count in RUNS]
    return table([*heads, *errors, "of 3 seeds of one order and one set"], lines)


@matplotlib.rc_context(STYLE)
def figure(methods: dict[str, Kept]) -> Figure:
    """Draw final success against the bytes that a method keeps, a line for each family."""
    drawn = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = drawn.subplots()
    families = dict.fromkeys(name.split()[0] for name in methods if "," not in name)
    for number, family in enumerate(families):
        own = [m for name, m in methods.items() if name.split()[0] == family and "," not in name]
        sizes = [
            max(1e4, m.costs("stored_bytes", True)) for m in own
        ]  # what keeps nothing stands at the left edge
        ends = [m.estimate("final_success") for m in own]
        order = np.argsort(sizes)
        heights = np.array([[e.value, e.value - e.low, e.high - e.value] for e in ends])[order].T
        look = {"color": LINE_COLOURS[number % 7], "marker": LINE_MARKERS[number % 7], "ms": 4}
        axes.errorbar(
            np.array(sizes)[order],
            100 * heights[0],
            100 * np.nan_to_num(heights[1:]),
            label=family,
            capsize=2,
            **look,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(lambda size, _: quantity(size, "B"))
    axes.set(xlabel="kept after ten tasks", ylabel="final success (%)", ylim=(0, 100))
    axes.grid()
    legend_below(drawn)
    return drawn


def conditions(runs: Sequence[Results]) -> str:
    """Say how many runs there are, and of which sources, models and processors."""
    facts = [
        (r.run.commit or "?", r.run.versions["models_digest"], r.run.conditions.get("processor", "?"))
        for r in runs
    ]
    names = ("source", "models", "processor")
    told = [
        f"{name} {', '.join(f'{str(value)[:48]} ({n})' for value, n in Counter(column).items())}"
        for name, column in zip(names, zip(*facts, strict=True), strict=True)
    ]
    return f"{len(runs)} runs: {'; '.join(told)}."


def tables() -> Iterator[tuple[str, list[str]]]:
    """Yield the tables of what is finished, by the mark of their place."""
    frontier = kept("frontier", list(FRONTIER.methods))
    if frontier:
        yield "conditions", [conditions([r for m in frontier.values() for r in m.runs.values()])]
        yield "frontier", rows(frontier)
        yield "pairs", pairs(frontier, PAIRS, ("final_success", "auc"))
        whole = len(frontier) == len(FRONTIER.methods) and min(len(m.runs) for m in frontier.values()) >= 3
        yield "highest", highest(frontier) if whole else ["No method is named before all have three seeds."]
    crossed = {n: _joined(frontier.get(n), found) for n, found in kept("seeds", list(SEEDS.methods)).items()}
    if len(crossed) == 2 and all(set(CROSSED) <= found.runs.keys() for found in crossed.values()):
        yield "seeds", seeds(crossed)
    if started := kept("starts", list(STARTS.methods)):
        yield "starts", rows(started)
        yield "pairs of starts", pairs(started, STARTED, ("nbt", "final_success"))


def _joined(first: Kept | None, second: Kept) -> Kept:
    return Kept(first.runs | second.runs, first.metrics | second.metrics) if first else second


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; 1 where the page has other numbers"
    )
    check = parser.parse_args().check
    text = new = PAGE.read_text(encoding="utf-8")
    for name, lines in tables():
        start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, rest = new.split(start)
        new = before + start + "\n".join([*lines, end]) + rest.split(end)[1]
    done = sum(run.is_done() for run in planned())
    new = new.replace(
        new[new.index("Finished: ") : new.index(" runs.")], f"Finished: {done} of {len(planned())}", 1
    )
    if check:
        return int(new != text)
    PAGE.write_text(new, encoding="utf-8")
    found = kept("frontier", list(FRONTIER.methods))
    if found:
        figure(found).savefig(PAGE.with_suffix(".png"), dpi=130, facecolor="white")
    return 0


if __name__ == "__main__":
    sys.exit(main())
