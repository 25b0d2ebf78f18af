"""Success against severity: how much of it a perturbation takes, where half is lost, and what two take together.

All conditions are run from the same starts, so a (task, start) is one cluster of outcomes. Intervals draw starts anew
within each task, the same for all conditions (a stratified bootstrap of clusters); tasks, kinds and severities are
fixed, and so is the policy. Where all episodes of a cell end alike, the bootstrap has nothing to vary, so success rates
have Wilson's intervals instead, and to other variances that of one start is added. Fewer than five starts have none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from libero_env.text import flatten, plain, shorten
from libero_eval.evaluation_file import EvaluationResult, by_start
from libero_eval.judging.comparability import settings
from libero_eval.protocols.clock import Clock, Latency
from libero_eval.stats.episodes import Counts, mcnemar_exact, score_interval
from lifelong.errors import ResultsError
from lifelong.stats.intervals import CONFIDENCE, LEAST_EPISODES, Estimate, Floats, holm, mean_success

DRAWS, SEED = 2000, 2023
ENDS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)  # quantiles
ONE_EPISODE = 0.96  # z²/4 at 95 %: the variance that Wilson's interval adds, in units of one episode
PLAIN = "without perturbations"
LATENCY = "clock"  # the kind that is no perturbation, but a setting of the protocol
Condition = tuple[tuple[str, float], ...]  # (kind, severity) of each perturbation, by kind; () is the base


@dataclass(frozen=True)
class Axis:
    """Success along the severities of one kind of perturbation.

    Attributes:
        severities: V severities in ascending order, from 0, the base.
        success: V success rates, means over tasks.
        area: Area under the line through these, over the measured severities and divided by their range: the success
            that is to be expected at a severity between 0 and the largest.
        kept: That area as a share of the base's success; 1 if nothing is lost, or success even rises.
        half: Least severity at which the line has fallen to half of the base's success; infinite where it has not.
        p_value: Two-sided p-value of no effect at all: then the outcomes of a start are exchangeable over severities,
            and are permuted.
    """

    kind: str
    severities: tuple[float, ...]
    success: tuple[Estimate, ...]
    area: Estimate
    kept: Estimate
    half: Estimate
    p_value: float

    def at(self, severity: float) -> Estimate | None:
        """Return the success at a severity; None if it was not measured."""
        return dict(zip(self.severities, self.success, strict=True)).get(severity)


@dataclass(frozen=True)
class Interaction:
    """What two perturbations take together.

    Attributes:
        condition: Both perturbations.
        success: Success with both.
        expected: Success if each left the share that it leaves alone: p_a · p_b / p_base; NaN where that is 0 / 0.
        excess: Success with both minus that: below 0 they hurt each other.
    """

    condition: Condition
    success: Estimate
    expected: float
    excess: Estimate


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of all conditions from the same starts.

    Attributes:
        tasks: T tasks.
        starts: S starts of each task: those from which no simulation error ended an episode in any condition.
        conditions: C conditions; the first is the base.
        successes: (C, T, S) outcomes.
        lost: Number of other starts.
    """

    tasks: tuple[str, ...]
    starts: tuple[int, ...]
    conditions: tuple[Condition, ...]
    successes: NDArray[np.bool_]
    lost: int = 0

    @classmethod
    def of(cls, results: Mapping[Condition, EvaluationResult]) -> "Outcomes":
        """Return the outcomes of results by their condition.

        Args:
            results: Result of each condition, the base, (), among them.

        Raises:
            ResultsError: There is no base, or a condition was not run in the same episodes, with the same policy and
                under the same settings.
        """
        if () not in results:
            raise ResultsError("there is no result without perturbations, with which the others are compared")
        base = results[()]
        tasks = tuple(task.task for task in base.tasks)
        lost = {
            start for result in results.values() for t in result.tasks for start, _ in t.simulation_errors
        }
        starts = tuple(start for start in base.init_states if start not in lost)
        if not starts:
            raise ResultsError("simulation errors ended an episode from each start: nothing can be paired")
        conditions = ((), *sorted(condition for condition in results if condition))
        for condition in conditions:
            episodes = {(t.task, tuple(sorted(t.starts))) for t in results[condition].tasks}
            if episodes != {(task, tuple(sorted(base.init_states))) for task in tasks}:
                raise ResultsError(
                    f"{name_of(condition)} was not run in the same tasks and starts as the base: they cannot be paired"
                )
            if odd := _odd_settings(base, results[condition], condition):
                raise ResultsError(
                    f"{name_of(condition)} was run under other settings than the base ({'; '.join(odd)}): run all "
                    "conditions again with --again, or these with an --out of their own"
                )
        won = [by_start(results[condition].tasks) for condition in conditions]
        outcomes = [[[row[task, start] for start in starts] for task in tasks] for row in won]
        return cls(tasks, starts, conditions, np.array(outcomes), len(base.init_states) - len(starts))

    @cached_property
    def rates(self) -> Floats:
        """(C,) success rates, means over tasks."""
        return self.successes.mean((1, 2))

    @cached_property
    def draws(self) -> Floats:
        """(B, C) success rates where starts are drawn anew within each task, the same for all conditions.

        Draws from S starts vary by (S - 1)/S of what starts do, which is made up for.
        """
        generator = np.random.default_rng(SEED)
        tasks, starts = len(self.tasks), len(self.starts)
        drawn = generator.integers(starts, size=(DRAWS, tasks, starts))
        weights = np.stack([(drawn == s).sum(-1) for s in range(starts)], axis=-1)
        drawn_rates = np.einsum("bts,cts->bc", weights, self.successes.astype(float)) / (tasks * starts)
        return self.rates + (drawn_rates - self.rates) * np.sqrt(starts / max(starts - 1, 1))

    @property
    def _least(self) -> float:
        """Variance that one start adds: nothing is certain because all episodes ended alike. NaN of fewer than five."""
        count = len(self.tasks) * len(self.starts)
        return ONE_EPISODE / count**2 if count >= LEAST_EPISODES else np.nan

    def success(self, condition: Condition) -> Estimate:
        """Return the success rate of a condition, see `mean_success`."""
        return mean_success(self.successes[self.conditions.index(condition)].sum(1), len(self.starts))

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """Every kind that was run by itself, the most harmful first."""
        kinds = dict.fromkeys(c[0][0] for c in self.conditions if len(c) == 1)
        return tuple(sorted((self._axis(kind) for kind in kinds), key=lambda axis: axis.kept.value))

    @cached_property
    def interactions(self) -> tuple[Interaction, ...]:
        """Every pair of perturbations of which each was run by itself at the same severity."""
        alone = {c[0] for c in self.conditions if len(c) == 1}
        pairs = [c for c in self.conditions if len(c) == 2 and set(c) <= alone]
        return tuple(map(self._interaction, pairs))

    def _axis(self, kind: str) -> Axis:
        conditions = [c for c in self.conditions if not c or (len(c) == 1 and c[0][0] == kind)]
        conditions.sort(key=lambda c: c[0][1] if c else 0.0)
        columns = [self.conditions.index(c) for c in conditions]
        severities = tuple(c[0][1] if c else 0.0 for c in conditions)
        rates, draws = self.rates[columns], self.draws[:, columns]
        weights = trapezoid(np.eye(len(severities)), severities) / severities[-1]  # of the area
        mean, drawn = float(rates @ weights), draws @ weights
        area = _estimate(mean, drawn, self._least, 0.0, 1.0)
        shares = _share(mean, float(rates[0])), _shares(drawn, draws[:, 0])
        kept = _estimate(*shares, self._least, 0.0, 1.0)
        halves = np.array([half_severity(severities, row) for row in draws])
        low, high = (
            np.quantile(halves, ENDS, method="nearest") if np.isfinite(self._least) else (np.nan, np.nan)
        )
        half = Estimate(half_severity(severities, rates), float(low), float(high))
        p_value = _exchange_test(self.successes[columns].reshape(len(columns), -1).T, weights)
        return Axis(kind, severities, tuple(map(self.success, conditions)), area, kept, half, p_value)

    def _interaction(self, condition: Condition) -> Interaction:
        columns = [self.conditions.index(c) for c in (condition, *((one,) for one in condition), ())]

        rates, draws = self.rates[columns], self.draws[:, columns]
        expected = _share(float(rates[1] * rates[2]), float(rates[3]))
        drawn = draws[:, 0] - _shares(draws[:, 1] * draws[:, 2], draws[:, 3])
        excess = _estimate(float(rates[0]) - expected, drawn, self._least, -1.0, 1.0)
        return Interaction(condition, self.success(condition), expected, excess)


@dataclass(frozen=True)
class EventRow:
    """What an event takes, in the episodes in which the expert solves the rest, against the matched ones without it.

    Attributes:
        name: The event, such as `camera=0.6@lifted`.
        episodes: Number of episodes.
        began: Number of these in which it began.
        solved: Number of these in which the expert, from the state just after it, solves what is left.
        counts: The last ones by outcome, first that without the event.
    """

    name: str
    episodes: int
    began: int
    solved: int
    counts: Counts

    @property
    def difference(self) -> Estimate:
        """Success with the event minus that without, with Tango's interval; NaN without episodes."""
        found = score_interval(self.counts)
        return Estimate(0.0 - found.value, 0.0 - found.high, 0.0 - found.low)

    @property
    def p_value(self) -> float:
        """Of no effect, McNemar's exact one."""
        return mcnemar_exact(self.counts)


def events_of(result: EvaluationResult) -> dict[tuple[str, int], tuple[bool, bool]]:
    """Return whether an event began in each episode, and whether the expert solves the rest of all that did."""
    return {
        (task.task, start): (any(at >= 0 for at in began), 1 in solved and 0 not in solved)
        for task in result.tasks
        for start, began, solved in zip(task.init_states, task.began, task.solved, strict=True)
    }


@dataclass(frozen=True)
class Robustness:
    """What perturbations do to one policy.

    Attributes:
        label: Name of the policy.
        outcomes: Outcomes of all conditions.
        paths: Folders of the results.
        redrawn: Number of draws that were given up, by condition.
        events: By condition with an event, whether it began in each episode, and whether the expert solves the rest.
        horizon: Control steps after which an episode ends, or these by suite.
        protocol: What the protocol without perturbations is called.
        settings: Everything else that policies beside each other should have in common, flat, by dotted name.
    """

    label: str
    outcomes: Outcomes
    paths: tuple[str, ...] = ()
    redrawn: Mapping[str, int] = field(default_factory=dict)
    events: Mapping[Condition, Mapping[tuple[str, int], tuple[bool, bool]]] = field(default_factory=dict)
    horizon: int | Mapping[str, int] = 0
    protocol: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def event_rows(self) -> tuple[EventRow, ...]:
        """What each condition with an event takes."""
        outcomes, rows = self.outcomes, []
        keys = [(task, start) for task in outcomes.tasks for start in outcomes.starts]
        before = outcomes.successes[0].ravel()
        for condition in filter(self.events.get, outcomes.conditions):
            began, solved = np.array([self.events[condition][key] for key in keys]).T
            after = outcomes.successes[outcomes.conditions.index(condition)].ravel()
            cells = (before & after, before & ~after, ~before & after, ~before & ~after)
            counts = Counts(*(int((cell & solved).sum()) for cell in cells))
            rows.append(EventRow(name_of(condition), len(keys), int(began.sum()), int(solved.sum()), counts))
        return tuple(rows)

    @cached_property
    def adjusted(self) -> dict[str, float]:
        """P-value of each kind, adjusted by Holm over all of them."""
        axes = self.outcomes.axes
        return dict(zip((axis.kind for axis in axes), holm([axis.p_value for axis in axes]), strict=True))

    @property
    def severities(self) -> tuple[float, ...]:
        """All severities of any kind, ascending, from 0."""
        return tuple(sorted({s for axis in self.outcomes.axes for s in axis.severities}))


def differences(policies: Sequence[Robustness]) -> list[str]:
    """Return a line for each difference of the tasks, starts, severities and settings of policies from the first."""
    first, *others = policies
    lines = []
    for other in others:
        a, b = (_compared(policy) for policy in (first, other))
        for key in sorted(a.keys() | b.keys()):
            if key.startswith(("tasks.", "severities of ")) and not (key in a and key in b):
                continue  # "tasks" says it; a kind that one was not evaluated under is not drawn for it
            one, two = (str(values.get(key, "none")) for values in (a, b))
            if one != two:
                lines.append(
                    f"{key}: {shorten(one, 60)} in {first.label}, {shorten(two, 60)} in {other.label}"
                )
    return lines


def _compared(policy: Robustness) -> dict[str, Any]:
    outcomes = policy.outcomes
    return {
        **policy.settings,
        "tasks": ", ".join(sorted(outcomes.tasks)),
        "starts": ", ".join(map(str, sorted(outcomes.starts))),
        **{
            f"severities of {axis.kind}": ", ".join(f"{s:g}" for s in axis.severities)
            for axis in policy.outcomes.axes
        },
    }


def _odd_settings(base: EvaluationResult, result: EvaluationResult, condition: Condition) -> list[str]:
    """Return where a condition's policy and settings are not the base's, apart from what the condition changes."""
    more = ({"evaluated": r.evaluated, "versions.mujoco": r.versions.get("mujoco")} for r in (base, result))
    a, b = (settings(one) | flatten(plain(its)) for one, its in zip((base, result), more, strict=True))
    changed, clock = ("tasks.", "protocol.world.perturb"), "protocol.action.clock"
    if LATENCY in dict(condition):
        for values in (a, b):
            values[clock] = str(replace(Clock.read(values.get(clock, "")), latency=Latency()))
    return [
        f"{key}: {shorten(str(b.get(key)), 60)} instead of {shorten(str(a.get(key)), 60)}"
        for key in sorted(a.keys() | b.keys())
        if a.get(key) != b.get(key) and not key.startswith(changed)
    ]


def name_of(condition: Condition) -> str:
    """Return a condition as text, such as `camera=0.4@lifted,light=0.2`."""
    parts = [(*kind.partition("@"), severity) for kind, severity in condition]
    return ",".join(f"{kind}={severity:g}{at}{trigger}" for kind, at, trigger, severity in parts) or PLAIN


def half_severity(severities: Sequence[float], rates: Floats) -> float:
    """Return the least severity at which the line through the rates has fallen to half of the first; else infinity.

    Args:
        severities: V severities in ascending order.
        rates: (V,) success rates.
    """
    limit = rates[0] / 2
    for k in range(1, len(rates)):
        if rates[k] <= limit < rates[k - 1]:
            share = (rates[k - 1] - limit) / (rates[k - 1] - rates[k])
            return float(severities[k - 1] + share * (severities[k] - severities[k - 1]))
    return float("inf")


def _exchange_test(outcomes: NDArray[np.bool_], weights: Floats) -> float:
    """Return the p-value of the area less the base's success, where the outcomes of a start are permuted.

    Args:
        outcomes: (N, V) outcomes of each start by severity, the base first.
        weights: (V,) weights of the area.
    """
    contrast = weights - np.eye(len(weights))[0]
    differing = outcomes[outcomes.any(1) & ~outcomes.all(1)].astype(float)  # others add nothing
    order = np.random.default_rng(SEED).random((DRAWS, *differing.shape)).argsort(-1)
    permuted = np.take_along_axis(np.broadcast_to(differing, order.shape), order, -1)
    observed, chance = differing.sum(0) @ contrast, permuted.sum(1) @ contrast
    return float((1 + (abs(chance) >= abs(observed) - 1e-9).sum()) / (1 + DRAWS))


def _share(part: float, whole: float) -> float:
    """Return a share, at most 1; NaN of nothing."""
    return min(1.0, float(part / whole)) if whole > 0 else float("nan")


def _shares(parts: Floats, wholes: Floats) -> Floats:
    shares = np.divide(parts, wholes, out=np.zeros_like(parts, dtype=float), where=np.asarray(wholes) > 0)
    return np.minimum(shares, 1.0)


def _estimate(value: float, draws: Floats, least: float, low: float, high: float) -> Estimate:
    """Return a value with the quantiles of its draws, to whose distances the variance `least` is added."""
    if np.isnan(value + least):
        return Estimate(value, np.nan, np.nan)
    ends = np.quantile(draws, ENDS)
    down, up = np.hypot(np.maximum([value - ends[0], ends[1] - value], 0), 1.96 * np.sqrt(least))
    return Estimate(value, max(low, float(value - down)), min(high, float(value + up)))
