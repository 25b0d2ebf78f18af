"""Simulated experiments: outcomes of every episode with spread between seeds and between starts, and known truth.

An episode succeeds where a normal variable exceeds a threshold (probit), so that the expected success is known exactly:
a mean for every algorithm, row and task, plus effects of the seed (shared by all algorithms), of the run, of the run on
a task, of what the run forgets, in all and in each cell, and of the start, which is the same in every row, run and
algorithm.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from lifelong.results.components import Sample
from lifelong.results.curves import Curve
from lifelong.results.samples import Member
from lifelong.results.scores import METRIC_NAMES, Cell, Scores, curve_weights, matrix_weights


@dataclass(frozen=True)
class Design:
    """What is simulated: numbers of tasks, starts, seeds, and points and starts of the learning curves."""

    tasks: int = 10
    starts: int = 20
    seeds: int = 5
    points: int = 6
    curve_starts: int = 5
    reporting: bool = False  # whether curves use the matrix's starts
    shared: float = 1.0  # effect of a seed on all algorithms, in units of `SEED`


@dataclass(frozen=True)
class Method:
    """An algorithm: success just after learning, share of it left after each further task, spread of its runs."""

    learned: float = 0.75
    kept: float = 1.0
    frozen: bool = False  # its rollouts repeat down every column
    spread: float = 1.0  # of its runs, in units of `RUN`

    def truth(self, tasks: int) -> np.ndarray:
        rows, cols = np.indices((tasks, tasks))
        return self.learned * self.kept ** np.maximum(rows - cols, 0)

    def curve(self, points: int) -> np.ndarray:
        return self.learned * (1 - np.exp(-3 * np.arange(points) / (points - 1)))


SEED, RUN, RUN_TASK, START = 0.05, 0.22, 0.4, 1.0  # standard deviations, probit scale
LATER, RUN_CELL = 0.25, 0.3  # of a run in all rows after a task's own; of each of its cells


def truths(method: Method, design: Design) -> dict[str, float]:
    """The expected value of every metric; forward transfer without a held maximum."""
    matrix, curve = method.truth(design.tasks), method.curve(design.points).mean()
    matrices, curves = matrix_weights(design.tasks), curve_weights(design.tasks)
    return {m: float((matrices[m] * matrix).sum() + curves[m].sum() * curve) for m in METRIC_NAMES}


@dataclass(frozen=True)
class Outcomes:
    """Successes of one algorithm: (seeds, tasks, rows, starts) and (seeds, tasks, points, curve starts)."""

    matrix: np.ndarray
    curves: np.ndarray
    frozen: bool


def simulate(methods: Sequence[Method], design: Design, rng: np.random.Generator) -> list[Outcomes]:
    """One experiment with all algorithms, on the same seeds and starts."""
    s, k, n, e = design.seeds, design.tasks, design.starts, design.points
    common = SEED * design.shared
    shared = common * rng.standard_normal((s, 1, 1, 1))
    hard = START * rng.standard_normal((1, k, 1, n))
    curve_hard = hard[..., : design.curve_starts]
    if not design.reporting:
        curve_hard = START * rng.standard_normal((1, k, 1, design.curve_starts))
    found = []
    for method in methods:
        run = method.spread * RUN
        task, later, cell = (method.spread * sd for sd in (RUN_TASK, LATER, RUN_CELL))
        after = np.tri(k, k, -1).T[None, :, :, None] * (not method.frozen)  # (1, tasks, rows, 1)
        total = np.sqrt(1 + common**2 + run**2 + task**2 + START**2 + after * (later**2 + cell**2))
        of_run = run * rng.standard_normal((s, 1, 1, 1)) + task * rng.standard_normal((s, k, 1, 1)) + shared
        rows = 1 if method.frozen else k
        level = ndtri(np.clip(method.truth(k).T[None, :, :, None], 1e-6, 1 - 1e-6)) * total
        forgetting = later * rng.standard_normal((s, 1, 1, 1)) + cell * rng.standard_normal((s, k, k, 1))
        noise = rng.standard_normal((s, k, rows, n))
        if method.frozen:
            level, forgetting = np.full((1, k, 1, 1), ndtri(method.learned)) * total[:, :, :1], 0.0
        noise = noise + after[:, :, :rows] * forgetting
        matrix = np.broadcast_to(level + of_run + hard + noise > 0, (s, k, k, n))
        total = np.sqrt(1 + common**2 + run**2 + task**2 + START**2)
        level = ndtri(np.clip(method.curve(e), 1e-6, 1 - 1e-6))[None, None, :, None] * total
        noise = rng.standard_normal((s, k, e, design.curve_starts))
        found.append(Outcomes(matrix, level + of_run + curve_hard + noise > 0, method.frozen))
    return found


def samples_of(outcomes: Outcomes, design: Design) -> dict[str, Sample]:
    """Every metric as `lifelong.results.samples` gives it, in one step for all seeds (a test compares them)."""
    y = outcomes.matrix.astype(float)
    rates, n, m = y.mean(-1), design.starts, design.curve_starts
    moved = (y - rates[..., None]) / np.sqrt(n * (n - 1))
    curve = outcomes.curves.astype(float).mean(2)  # (seeds, tasks, starts)
    of_curve = (curve - curve.mean(-1, keepdims=True)) / np.sqrt(m * (m - 1))
    matrices, curves = matrix_weights(design.tasks), curve_weights(design.tasks)
    k, s = design.tasks, design.seeds
    if design.reporting:
        strata = np.array([[2 * t + (i < m) for i in range(n)] for t in range(k)]).ravel()
    else:
        strata = np.concatenate([np.repeat(np.arange(k), n), k + np.repeat(np.arange(k), m)])
    found = {}
    for name in METRIC_NAMES:
        w, c = matrices[name].T, curves[name]  # (tasks, rows)
        of_matrix = np.einsum("tr,strn->stn", w, moved)
        added = c[:, None] * of_curve
        if design.reporting:
            of_matrix[..., :m] += added
            deviations = of_matrix.reshape(s, -1)
        else:
            deviations = np.concatenate([of_matrix.reshape(s, -1), added.reshape(s, -1)], axis=1)
        different = (w.sum(1) ** 2 if outcomes.frozen else (w**2).sum(1)).sum() / n + (c**2).sum() / m
        deviations = np.where(np.abs(deviations) < 1e-12, 0.0, deviations)
        values = np.einsum("tr,str->s", w, rates) + curve.mean(-1) @ c
        different = np.full(s, different if different > 1e-20 else 0.0)
        found[name] = Sample(tuple(range(s)), values, deviations, strata, different)
    return found


def members_of(outcomes: Outcomes, design: Design) -> list[Member]:
    """The same as runs, as a run directory gives them."""
    k, first = design.tasks, 0 if design.reporting else 50 - design.curve_starts
    found = []
    for seed in range(design.seeds):
        y, curves = outcomes.matrix[seed], outcomes.curves[seed].astype(float)
        cells = tuple(
            Cell(r, t, f"task {t}", np.arange(design.starts), y[t, r], t if outcomes.frozen else r)
            for r in range(k)
            for t in range(r + 1)
        )
        rows = np.tril(np.ones((k, k), bool))
        count = np.full(design.points, design.curve_starts)
        starts = np.arange(first, first + design.curve_starts)
        points = tuple(
            Curve(np.arange(design.points), c.mean(1), count, c[..., None], starts, (f"task {t}",))
            for t, c in enumerate(curves)
        )
        rates = np.where(rows, y.mean(-1).T, np.nan)
        found.append(Member(Scores(points, rates, rows * design.starts, (), cells, "plain"), seed))
    return found


def with_spread(method: Method, rng: np.random.Generator, sd: float = 0.35) -> Method:
    """The method with another spread between its runs: log-normal, so that algorithms differ in it."""
    return replace(method, spread=float(np.exp(sd * rng.standard_normal() - sd**2)))
