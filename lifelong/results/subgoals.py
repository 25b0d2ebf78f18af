"""Which parts of the goals were learned, and which of them forgotten.

A goal is a conjunction of atoms, such as (Turnon stove_1) and (On pot_1 stove_1_cook_region). An episode that fails
may have reached some of them. What held before the policy acted is no achievement and does not count.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.results.metrics import Estimate, combine_intervals, wilson_interval
from lifelong.results.records import EvalRecord


@dataclass(frozen=True)
class AtomRates:
    """How often one part of a task's goal was reached; shares of the episodes.

    Attributes:
        task: Position in the sequence.
        atom: As in the task file.
        at_start: How often it held before the policy acted.
        learned_ever, learned_end: How often it held at any time, and at the end, right after learning the task.
        final_ever, final_end: The same after the last task learned.
    """

    task: int
    atom: str
    at_start: float
    learned_ever: float
    learned_end: float
    final_ever: float
    final_end: float

    @property
    def forgotten(self) -> float:
        """The drop from just learned to last, of having been reached at any time."""
        return self.learned_ever - self.final_ever


@dataclass(frozen=True)
class PredicateRates:
    """How often atoms with a predicate were reached at any time, averaged over the tasks that ask for it.

    Attributes:
        predicate: Such as In.
        tasks: Positions of the tasks.
        learned: Right after learning each of the tasks.
        final: After the last task learned.
        forgotten: Learned less final; NaN where no task was followed by another.
    """

    predicate: str
    tasks: tuple[int, ...]
    learned: Estimate
    final: Estimate
    forgotten: Estimate


@dataclass(frozen=True)
class Subgoals:
    """The parts of the goals of a run; both empty where its records do not tell of them."""

    atoms: tuple[AtomRates, ...] = ()
    predicates: tuple[PredicateRates, ...] = ()


def predicate_of(atom: str) -> str:
    """`(In milk_1 basket_1_contain_region)` -> `In`."""
    return atom.strip("() ").split(" ", 1)[0]


def subgoals(evaluations: Iterable[EvalRecord], tasks: int) -> Subgoals:
    """What became of the atoms of the first so many tasks.

    Args:
        evaluations: Records of a run; those of learning curves are passed over. Of equal keys the last one counts.
        tasks: Number of tasks learned.
    """
    cells = {
        (r.learned, r.task): r for r in evaluations if r.phase == "matrix" and r.atoms and r.learned < tasks
    }
    pairs: list[tuple[EvalRecord, EvalRecord]] = []
    for task in range(tasks):
        rows = [learned for learned, other in cells if other == task]
        if rows:
            pairs.append((cells[min(rows), task], cells[max(rows), task]))
    return Subgoals(tuple(a for pair in pairs for a in _atoms(*pair)), tuple(_predicates(pairs)))


def _atoms(learned: EvalRecord, final: EvalRecord) -> list[AtomRates]:
    held = (
        learned.atoms_at_start,
        learned.atoms_ever,
        learned.atoms_at_end,
        final.atoms_ever,
        final.atoms_at_end,
    )
    columns = [np.asarray(rows, float).mean(0) for rows in held]
    return [AtomRates(learned.task, a, *(float(c[i]) for c in columns)) for i, a in enumerate(learned.atoms)]


def _predicates(pairs: Sequence[tuple[EvalRecord, EvalRecord]]) -> list[PredicateRates]:
    found: list[PredicateRates] = []
    names = dict.fromkeys(predicate_of(a) for learned, _ in pairs for a in learned.atoms)
    for name in names:
        counted = []
        for learned, final in pairs:
            shares = [_shares(record, name) for record in (learned, final)]
            if all(len(s) for s in shares):
                counted.append((learned, final, shares))
        if not counted:  # it held from the start wherever it is asked for
            continue
        same = all(learned.learned == final.learned for learned, final, _ in counted)
        first, last = ([shares[i] for *_, shares in counted] for i in (0, 1))
        # A task that nothing follows has one evaluation only: it is no difference of two.
        drops = [s for learned, final, s in counted if learned.learned != final.learned]
        forgotten = _mean([s[0] for s in drops], [s[1] for s in drops], over=len(counted))
        found.append(
            PredicateRates(
                name,
                tuple(learned.task for learned, *_ in counted),
                _mean(first),
                _mean(last),
                Estimate(np.nan, np.nan, np.nan) if same else forgotten,
            )
        )
    return found


def _shares(record: EvalRecord, predicate: str) -> NDArray[np.float64]:
    """Of each episode the share of the predicate's atoms that were reached; those it began with do not count."""
    mine = [i for i, atom in enumerate(record.atoms) if predicate_of(atom) == predicate]
    open_ = ~np.asarray(record.atoms_at_start, bool)[:, mine]
    reached = np.asarray(record.atoms_ever, bool)[:, mine] & open_
    asked = open_.sum(1)
    return reached.sum(1)[asked > 0] / asked[asked > 0]


def _mean(
    plus: Sequence[NDArray[np.float64]], minus: Sequence[NDArray[np.float64]] = (), over: int | None = None
) -> Estimate:
    """Mean over tasks, or mean difference, with the interval of `combine_intervals`.

    Atoms of one episode are not independent, so an episode counts once, with the share of them it reached;
    Wilson's interval is wide enough for that, as no share in [0, 1] varies more than a success of its mean.
    """
    cells, count = [*plus, *minus], over or len(plus)
    rates, episodes = np.array([c.mean() for c in cells]), np.array([len(c) for c in cells])
    weights = np.array([1.0] * len(plus) + [-1.0] * len(minus)) / count
    low, high = wilson_interval(rates * episodes, episodes)
    return combine_intervals(weights, rates, low, high)
