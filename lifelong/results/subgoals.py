"""Subgoals: which atoms of the goals were learned, and which were forgotten.

A goal is a conjunction of atoms, such as (Turnon stove_1) and (On pot_1 stove_1_cook_region). A failed episode may have
reached some of them. Atoms that held before the policy acted do not count.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.results.records import EvalRecord
from lifelong.stats.intervals import UNKNOWN, Estimate, difference_of, mean_success


@dataclass(frozen=True)
class AtomRates:
    """How often one atom of a task's goal held, as shares of the episodes; NaN where that was not measured.

    Attributes:
        task: Position in the sequence.
        atom: Atom as in the task file.
        at_start: Share in which it held before the policy acted.
        learned_ever: Share in which it held at any time, right after learning the task.
        learned_end: Share in which it held at the end, right after learning the task.
        final_ever: Share in which it held at any time, after the last task learned.
        final_end: Share in which it held at the end, after the last task learned.
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
        """Drop of `learned_ever` to `final_ever`."""
        return self.learned_ever - self.final_ever


@dataclass(frozen=True)
class PredicateRates:
    """How often atoms with a predicate were reached at any time: means over the tasks whose goals contain it.

    They are NaN unless that was measured of all these tasks.

    Attributes:
        predicate: Name of the predicate, such as In.
        learned: Rate right after learning each of the tasks.
        final: Rate after the last task learned.
        forgotten: Learned minus final; NaN where no task was followed by another.
    """

    predicate: str
    tasks: tuple[int, ...]
    learned: Estimate
    final: Estimate
    forgotten: Estimate


@dataclass(frozen=True)
class Subgoals:
    """The subgoals of a run; empty where its records have no atoms."""

    atoms: tuple[AtomRates, ...] = ()
    predicates: tuple[PredicateRates, ...] = ()


def predicate_of(atom: str) -> str:
    """Return the predicate of an atom: In of (In milk_1 basket_1_contain_region)."""
    return atom.strip("() ").split(" ", 1)[0]


def subgoals(evaluations: Iterable[EvalRecord], ends: Sequence[int]) -> Subgoals:
    """Return how often the atoms of the learned tasks were reached.

    Args:
        evaluations: Records of a run; those of learning curves are ignored. Of equal keys the last one counts.
        ends: Of each learned task, the last one that was learned together with it.
    """
    tasks = len(ends)
    cells = {
        (r.learned, r.task): r for r in evaluations if r.phase == "matrix" and r.atoms and r.learned < tasks
    }
    pairs: list[tuple[EvalRecord, EvalRecord]] = []
    for task in range(tasks):
        rows = [learned for learned, other in cells if other == task]
        if rows:
            pairs.append((cells[min(rows), task], cells[max(rows), task]))
    atoms = tuple(a for pair in pairs for a in _atoms(*pair, ends))
    return Subgoals(atoms, tuple(_predicates(pairs, ends)))


def _atoms(learned: EvalRecord, final: EvalRecord, ends: Sequence[int]) -> list[AtomRates]:
    just, last = (1.0 if known else np.nan for known in _measured(learned, final, ends))
    held = (
        (1.0, learned.atoms_at_start),
        (just, learned.atoms_ever),
        (just, learned.atoms_at_end),
        (last, final.atoms_ever),
        (last, final.atoms_at_end),
    )
    columns = [known * np.asarray(rows, float).mean(0) for known, rows in held]
    return [AtomRates(learned.task, a, *(float(c[i]) for c in columns)) for i, a in enumerate(learned.atoms)]


def _measured(learned: EvalRecord, final: EvalRecord, ends: Sequence[int]) -> tuple[bool, bool]:
    """Return whether a task's first and last evaluations are those just after learning it, and at the end."""
    return learned.learned == ends[learned.task], final.learned == ends[-1]


def _predicates(pairs: Sequence[tuple[EvalRecord, EvalRecord]], ends: Sequence[int]) -> list[PredicateRates]:
    found: list[PredicateRates] = []
    names = dict.fromkeys(predicate_of(a) for learned, _ in pairs for a in learned.atoms)
    for name in names:
        counted = []
        for learned, final in pairs:
            shares = [_shares(record, name) for record in (learned, final)]
            if all(len(s) for s in shares):
                counted.append((learned, final, shares))
        if not counted:  # it held from the start in all goals that contain it
            continue
        same = all(learned.learned == final.learned for learned, final, _ in counted)
        first, last = ([shares[i] for *_, shares in counted] for i in (0, 1))
        # A task that is not followed by another has one evaluation only, so no difference.
        drops = [s for learned, final, s in counted if learned.learned != final.learned]
        before, after = (_mean([s[i] for s in drops]) for i in (0, 1))
        forgotten = difference_of(before, after, len(drops) / len(counted))
        just, end = map(all, zip(*(_measured(a, b, ends) for a, b, _ in counted), strict=True))
        found.append(
            PredicateRates(
                name,
                tuple(learned.task for learned, *_ in counted),
                _mean(first) if just else UNKNOWN,
                _mean(last) if end else UNKNOWN,
                forgotten if just and end and not same else UNKNOWN,
            )
        )
    return found


def _shares(record: EvalRecord, predicate: str) -> NDArray[np.float64]:
    """Return each episode's share of the predicate's atoms that were reached, except those that held at its start."""
    columns = [i for i, atom in enumerate(record.atoms) if predicate_of(atom) == predicate]
    unmet = ~np.asarray(record.atoms_at_start, bool)[:, columns]
    reached = np.asarray(record.atoms_ever, bool)[:, columns] & unmet
    count = unmet.sum(1)
    return reached.sum(1)[count > 0] / count[count > 0]


def _mean(shares: Sequence[NDArray[np.float64]]) -> Estimate:
    """Return the mean over tasks, with the interval of `mean_success`.

    Atoms of one episode are not independent, so an episode counts once, with the share that it reached;
    Wilson's interval is wide enough for that, as no share in [0, 1] varies more than a success rate of its mean.
    """
    return mean_success([each.sum() for each in shares], [len(each) for each in shares])
