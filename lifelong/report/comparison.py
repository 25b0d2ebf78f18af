"""Comparison of groups of runs: means over seeds, intervals, differences, forgetting by task, costs.

Intervals and tests are those of `lifelong.stats.methods`.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lifelong.errors import ComparisonError
from lifelong.report.runs import Group, Run, algorithm_of, settings_of, stage_of
from lifelong.report.unlike import check_same_world, unlike
from lifelong.results.provenance import few_of
from lifelong.results.shifts import shift_scores
from lifelong.stats.intervals import mean_and_half_width
from lifelong.stats.methods import MARGIN, MethodRun, paired_difference, spreads, statistics, units
from lifelong.stats.metrics import METRIC_NAMES, intransigence, metric_values

MUJOCO = "mujoco"  # back end of results that name none


@dataclass(frozen=True)
class Plan:
    """Which pairs of methods are compared, as it was decided before their results were seen.

    Attributes:
        references: Labels of the methods that each other one is compared with; two methods are compared in any case.
        all_pairs: Whether every method is compared with every other instead.
        margin: Difference in success from which on two methods are not equivalent.
        other_worlds: Whether runs in other models or other physics may be compared.
    """

    references: tuple[str, ...] = ()
    all_pairs: bool = False
    margin: float = MARGIN
    other_worlds: bool = False


def compare(groups: Sequence[Group], plan: Plan = Plan()) -> dict[str, Any]:  # noqa: B008 - frozen
    """Compute all statistics of the groups, as plain data with NaN where something is unknown.

    Args:
        groups: Groups of runs that differ in seed and order only. Runs without a learned task are ignored.
        plan: Pairs to be compared.

    Returns:
        `groups`: by label, with `runs`, `seeds`, `orders`, `told_task`, `spreads` (between runs that differ in one
        thing alone), `metrics` (mean, standard_error, low, high, the value of each seed or order), `other_conventions`
        (of other papers), `published` (FWT and AUC of eq. 3 as written), `forgetting_by_task` (NBT by task name),
        `subgoals`, `costs` and `shifts` (by held-out shift: `final` success without and under it, `lost` with Student's
        interval, and by reference `lost_less`, paired by seed).
        `differences` and `statistics`: see `lifelong.stats.methods.statistics`.
        `after_base_stage`: `metrics` by label and `differences` over the later tasks alone, as if the sequence began
        with them, of the methods whose runs all learned a task after a base stage; None if there are none. `backend`:
        what simulated all rollouts. `conditions`: sentences about all else in which runs differ, see
        `lifelong.report.unlike.unlike`.

    Raises:
        ComparisonError: The runs are of different back ends or worlds, or a reference is not a method.
    """
    measured = {g.label: [r for r in g.runs if r.metrics is not None] for g in groups}
    check_same_back_end(
        {f"{g.label} ({r.path})": r.record.backend for g in groups for r in measured[g.label]}
    )
    if not plan.other_worlds:
        check_same_world(groups)
    planned: dict[str, Any] = {"all_pairs": plan.all_pairs, "margin": plan.margin}
    methods = {label: runs_of(runs) for label, runs in measured.items() if runs}
    found = statistics(methods, plan.references, **planned)
    later = {
        label: [replace(m, scores=m.scores.without_first()) for m in runs]
        for label, runs in methods.items()
        if all(r.results.has_later_tasks() for r in measured[label])
    }
    references = tuple(r for r in plan.references if r in later)
    reference = _reference(measured)
    compared = {
        g.label: _group(g, measured[g.label], found["metrics"].get(g.label), reference) for g in groups
    }
    shifted = {label: _shifted(runs) for label, runs in measured.items()}
    for label, group in compared.items():
        others = {other: shifted[other] for other in plan.references if other != label}
        group["shifts"] = _shifts(shifted[label], others)
    return {
        "backend": next((r.record.backend for runs in measured.values() for r in runs), MUJOCO),
        "groups": compared,
        "differences": found["differences"],
        "statistics": found["statistics"],
        "after_base_stage": statistics(later, references, **planned) if later else None,
        "conditions": unlike(groups),
    }


def runs_of(runs: Sequence[Run]) -> list[MethodRun]:
    """Return runs as what the statistics take."""
    return [
        MethodRun(r.results.scores(), r.record.seed, r.record.tasks, r.record.demonstrations_seed)
        for r in runs
    ]


def findings(found: Mapping[str, Any], names: Mapping[str, str], most: int = 12) -> list[str]:
    """Return in sentences which of the compared pairs differ, which are equivalent, and which are left open.

    Args:
        found: Result of `lifelong.stats.methods.statistics`, or of `compare`.
        names: Metrics to name, and how.
        most: Number of pairs that are named of each kind; of further ones, their number.
    """
    pairs, lines = found["differences"], []
    if not pairs and len(found.get("groups") or found["metrics"]) > 2:
        return [
            "No difference is tested: name the method to compare the others with (--reference), or --all-pairs."
        ]
    margin = found["statistics"]["margin"]
    for metric, name in names.items():
        rows = [(f"{d['of']} − {d['less']}", d["metrics"][metric]) for d in pairs]
        rows = [(pair, m) for pair, m in rows if _known(m["value"])]
        tested = sorted(((p, m) for p, m in rows if _known(m["p_value"])), key=lambda row: row[1]["p_value"])
        kinds = {
            "Different": [_named(p, m) for p, m in tested if m["significant"]],
            f"Equivalent within ±{100 * margin:g} points": [p for p, m in tested if m["equivalent"]],
            "Open": [
                _named(p, m, m["seeds"]) for p, m in tested if not m["significant"] and not m["equivalent"]
            ],
            "Not tested (fewer than three seeds, or no spread between them)": [
                _named(p, m) for p, m in rows if not _known(m["p_value"])
            ],
        }
        texts = [f"{kind}: {few_of(of_kind, most)}." for kind, of_kind in kinds.items() if of_kind]
        lines += [f"{name}. {' '.join(texts)}"] if texts else []
    return lines


def _named(pair: str, m: Mapping[str, Any], seeds: int | None = None) -> str:
    """Return a pair with its difference in percentage points, its interval, and how many seeds would show it."""
    text = f"{100 * m['value']:+z.1f}"
    if _known(m["low"]):
        text += f" [{100 * m['low']:z.1f}, {100 * m['high']:z.1f}]"
    return f"{pair} ({text.replace('-', '−')}{f'; {seeds} seeds needed' if seeds else ''})"


def _known(value: float | None) -> bool:
    """Return whether a number is known; JSON has null where it is not."""
    return value is not None and bool(np.isfinite(value))


_References = Mapping[Hashable, Sequence[Run]]  # by settings


def _reference(measured: Mapping[str, Sequence[Run]]) -> _References:
    """Return the runs whose policies learned each task alone, or else all together, by their settings."""
    of_algorithm: dict[str, dict[Hashable, list[Run]]] = {"multitask": {}, "singletask": {}}
    for run in (run for runs in measured.values() for run in runs if algorithm_of(run) in of_algorithm):
        of_algorithm[algorithm_of(run)].setdefault(_besides_algorithm(run), []).append(run)
    return of_algorithm["multitask"] | of_algorithm["singletask"]


def _success_alone(run: Run, reference: _References) -> dict[str, float]:
    """Return the mean success by task of the reference with a run's settings: of its own seeds, else of all."""
    fitting = reference.get(_besides_algorithm(run), ())
    seeds = [(r.record.seed, r.record.demonstrations_seed) for r in (run, *fitting)]
    own = [r for r, drawn in zip(fitting, seeds[1:], strict=True) if drawn == seeds[0]]
    found: dict[str, list[float]] = {}
    for one in own or fitting:
        for name, rate in zip(one.record.tasks, _just_learned(one), strict=True):
            found.setdefault(name, []).append(rate)
    return {name: float(np.mean(rates)) for name, rates in found.items()}


def _besides_algorithm(run: Run) -> Hashable:
    return tuple(item for item in settings_of(run).items() if item[0].partition(".")[0] != "algo")


def _just_learned(run: Run) -> list[float]:
    """Return the success on each task after the stage that learned it."""
    matrix = run.results.success_matrix()[0]
    return [float(matrix[stage_of(run, task)[-1], task]) for task in range(len(matrix))]


def _conventions(runs: Sequence[Run], reference: _References) -> dict[str, dict[str, float]]:
    """Return what other papers print, by its name in `lifelong.stats.metrics`, over the runs."""
    rows = []
    for run in runs:
        success = _success_alone(run, reference)
        alone = [success.get(name, np.nan) for name in run.record.tasks[: run.learned]]
        learned = np.diag(_just_learned(run)[: run.learned])
        rows.append(run.results.other_conventions() | {"intransigence": intransigence(learned, alone)})
    means = {name: _mean([row[name] for row in rows]) for name in (rows[0] if rows else {})}
    return {name: mean for name, mean in means.items() if np.isfinite(mean["mean"])}


def _group(
    group: Group, runs: Sequence[Run], metrics: Mapping[str, Any] | None, reference: _References
) -> dict[str, Any]:
    return {
        "runs": [str(r.path) for r in group.runs],
        "seeds": [r.record.seed for r in group.runs],
        "orders": len({r.record.tasks for r in group.runs}),
        "measured": len(runs),
        "spreads": spreads(runs_of(runs)),
        "told_task": group.told_task,
        "metrics": metrics or {name: dict(_UNKNOWN) for name in METRIC_NAMES},
        "other_conventions": _conventions(runs, reference),
        "published": published_metrics(runs),
        "forgetting_by_task": _forgetting(runs),
        "subgoals": _subgoals(runs),
        "costs": costs_of(runs),
    }


_UNKNOWN = {**dict.fromkeys(("mean", "standard_error", "low", "high"), float("nan")), "values": []}


def published_metrics(runs: Sequence[Run]) -> dict[str, float]:
    """Return the means of FWT and AUC as eq. 3 is written, for comparison with published numbers."""
    values = [metric_values(r.results.scores("curve", "published")) for r in runs]
    return {name: float(np.mean([v[name] for v in values])) if values else np.nan for name in ("fwt", "auc")}


def _forgetting(runs: Sequence[Run]) -> dict[str, dict[str, float]]:
    """Return NBT_k of every task by its name, over the runs in which another task followed it.

    Of a task that a run learns several times, the mean is the run's.
    """
    found: dict[str, list[float]] = {}
    for run in runs:
        assert run.metrics is not None
        own: dict[str, list[float]] = {}
        followed = run.record.group(run.learned - 1).start
        for name, value in zip(run.record.tasks[:followed], run.metrics.nbt_by_task, strict=False):
            own.setdefault(name, []).append(float(value))
        for name, values in own.items():
            found.setdefault(name, []).append(float(np.mean(values)))
    return {name: _mean(values) for name, values in found.items()}


def _subgoals(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, float]]]:
    """Return how often each predicate was reached right after learning, at the end, and the difference."""
    rows = [p for run in runs for p in run.results.subgoals().predicates]
    return {
        name: {
            what: _mean([getattr(p, what).value for p in rows if p.predicate == name])
            for what in ("learned", "final", "forgotten")
        }
        for name in dict.fromkeys(p.predicate for p in rows)
    }


# shift -> (seed, data_seed) -> final success without and under it
_Shifted = dict[str, dict[Hashable, list[tuple[float, float]]]]


def _shifted(runs: Sequence[Run]) -> _Shifted:
    """Return final success without and under each held-out shift, of the runs of each seed, or order."""
    found: _Shifted = {}
    for unit, run in zip(units(runs_of(runs)), runs, strict=True):
        for score in shift_scores(run.results):
            both = score.success("final").value, score.success("final_shifted").value
            if np.isfinite(both).all():
                found.setdefault(score.shift, {}).setdefault(unit, []).append(both)
    return found


def _lost(rates: Mapping[Hashable, Sequence[tuple[float, float]]]) -> dict[Hashable, float]:
    return {unit: float(np.mean([a - b for a, b in pairs])) for unit, pairs in rates.items()}


def _shifts(own: _Shifted, references: Mapping[str, _Shifted]) -> dict[str, dict[str, Any]]:
    """Return what a method's final success loses under each held-out shift, alone and beside references."""
    found: dict[str, dict[str, Any]] = {}
    for shift, rates in own.items():
        final, under = np.mean([np.mean(pairs, axis=0) for pairs in rates.values()], axis=0)
        lost, less = _lost(rates), dict[str, Any]()
        for name, others in references.items():
            theirs = _lost(others.get(shift, {}))
            gaps = [value - theirs[unit] for unit, value in lost.items() if unit in theirs]
            if gaps:
                less[name] = asdict(paired_difference(np.array(gaps)).estimate)
        found[shift] = {
            "runs": sum(map(len, rates.values())),
            "final": float(final),
            "final_shifted": float(under),
            "lost": asdict(paired_difference(np.array(list(lost.values()))).estimate),
            "lost_less": less,
        }
    return found


def costs_of(runs: Sequence[Run]) -> dict[str, float]:
    """Return the costs of a method: what is kept at the end, the largest peaks, and means over tasks of all else.

    Costs that no run recorded are omitted.
    """
    tables = [_costs_by_task(run) for run in runs]
    by_task, last = [row for rows in tables for row in rows], [row for rows in tables for row in rows[-1:]]
    found = {}
    for name in dict.fromkeys(name for row in by_task for name in row):
        values = [
            row[name] for row in (last if name in ("stored_bytes", "kept_share") else by_task) if name in row
        ]
        reduce = np.max if name.startswith("peak_") else np.mean
        found[name] = float(reduce(values)) if values else float("nan")
    return found


def _costs_by_task(run: Run) -> list[dict[str, float]]:
    """Return the costs of every task; tasks that are learned together have equal parts of times, updates, windows."""
    rows = []
    for task, costs in run.results.costs_by_task().items():
        count = len(stage_of(run, task))
        rows += [
            {
                k: v / count if k.endswith("_seconds") or k in ("updates", "windows") else v
                for k, v in costs.items()
            }
        ] * count
    return rows


def _mean(values: Sequence[float]) -> dict[str, float]:
    known = [v for v in values if not np.isnan(v)]
    mean, half = mean_and_half_width(known)
    return {"mean": mean, "half_width": half}


def check_same_back_end(of: Mapping[str, str]) -> None:
    """Check that results are of one back end: the physics and the pictures of others differ.

    Args:
        of: Back end of each result by its label.

    Raises:
        ComparisonError: There are several; the message names a result of each.
    """
    found = {name: label for label, name in of.items()}
    if len(found) > 1:
        names = ", ".join(f"{label} on backend={name}" for name, label in found.items())
        raise ComparisonError(
            f"results of different back ends are not compared: {names}; evaluate all on one, see --backend"
        )
