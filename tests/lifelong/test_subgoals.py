"""Subgoals: rates, forgetting, and atoms that held from the start."""

from dataclasses import replace

import numpy as np
import pytest

from lifelong.results.records import EvalRecord
from lifelong.results.subgoals import predicate_of, subgoals
from tests.harness.records import evaluation

POT = ("(Turnon stove_1)", "(On pot_1 stove_1)")
TWO = ("(In soup_1 basket_1)", "(In milk_1 basket_1)", "(Close drawer_1)")


def record(
    learned: int, task: int, atoms: tuple[str, ...], ever: list[int], start: list[int] | None = None
) -> EvalRecord:
    """Ten episodes; atom a is reached in the first `ever[a]` of them, and holds from the start in `start[a]`."""
    first = lambda counts: tuple(tuple(i < n for n in counts) for i in range(10))  # noqa: E731
    start = start or [0] * len(atoms)
    truths = {"atoms_at_start": start, "atoms_ever": ever, "atoms_at_end": [n // 2 for n in ever]}
    truths = {name: first(counts) for name, counts in truths.items()}
    return evaluation("matrix", learned, 0, task, min(ever), 10, atoms=atoms, **truths)


RUN = [
    record(0, 0, POT, [10, 8]), record(1, 0, POT, [9, 3]), record(1, 1, TWO, [9, 5, 10], [0, 0, 10]),
    record(2, 0, POT, [10, 1]), record(2, 1, TWO, [8, 2, 10], [0, 0, 10]), record(2, 2, POT, [10, 10])
]  # fmt: skip


def test_every_atom_of_every_task():
    found = subgoals(RUN, range(3))
    assert [a.atom for a in found.atoms] == [*POT, *TWO, *POT]
    turn, on = found.atoms[:2]
    assert (turn.learned_ever, turn.final_ever, turn.forgotten) == (1.0, 1.0, 0.0)
    assert (on.learned_ever, on.learned_end, on.final_ever) == (0.8, 0.4, 0.1)
    assert on.forgotten == pytest.approx(0.7)
    assert found.atoms[4].at_start == 1.0


def test_predicates_are_averaged_over_tasks_and_the_last_has_forgotten_nothing():
    found = {p.predicate: p for p in subgoals(RUN, range(3)).predicates}
    assert set(found) == {"Turnon", "On", "In"}, "the drawer was closed already"
    assert found["On"].tasks == (0, 2)
    assert found["On"].learned.value == pytest.approx((0.8 + 1.0) / 2)
    assert found["On"].forgotten.value == pytest.approx(0.7 / 2)
    assert found["In"].learned.value == pytest.approx(0.7) and found["In"].final.value == pytest.approx(0.5)
    for p in found.values():
        assert p.forgotten.value == pytest.approx(p.learned.value - p.final.value)
        assert p.forgotten.low < p.forgotten.value < p.forgotten.high


def test_what_held_from_the_start_does_not_count():
    half = record(0, 0, POT, [10, 10], [5, 0])  # turned on already in five episodes, reached in the others
    one = {p.predicate: p for p in subgoals([half], [0]).predicates}
    assert one["Turnon"].learned.value == 1.0 and np.isnan(one["Turnon"].forgotten.value)
    missed = record(0, 0, POT, [5, 10], [5, 0])  # never turned on where it was off
    assert {p.predicate: p.learned.value for p in subgoals([missed], [0]).predicates}["Turnon"] == 0.0


def test_the_last_of_equal_records_counts_and_tasks_that_are_not_done_do_not():
    again = record(2, 0, POT, [10, 9])
    assert subgoals([*RUN, again], range(3)).atoms[1].final_ever == pytest.approx(0.9)
    assert [a.task for a in subgoals(RUN, [0]).atoms] == [0, 0]


@pytest.mark.parametrize(("rows", "ends", "unknown"), [
    ([(0, 0), (1, 1), (2, 2)], [0, 1, 2], "final"),  # eval.cells=diagonal
    ([(2, 0), (2, 1), (2, 2)], [0, 1, 2], "learned"),  # last_row
    ([(2, 0), (2, 1), (2, 2)], [2, 2, 2], ""),  # all learned together
])  # fmt: skip
def test_what_was_not_measured_is_not_taken_from_elsewhere(rows, ends, unknown):
    found = subgoals([r for r in RUN if (r.learned, r.task) in rows], ends)
    for name in ("learned", "final"):
        assert np.isnan(getattr(found.atoms[1], f"{name}_ever")) == (name == unknown)
        assert all(np.isnan(getattr(p, name).value) == (name == unknown) for p in found.predicates)
    assert all(np.isnan(p.forgotten.value) for p in found.predicates)
    assert np.isnan(found.atoms[1].forgotten) == bool(unknown)


def test_records_without_atoms_have_no_subgoals():
    names = ("atoms", "atoms_at_start", "atoms_ever", "atoms_at_end")
    old = [replace(r, **dict.fromkeys(names, ())) for r in RUN]
    assert subgoals(old, range(3)) == subgoals([], ())


def test_rows_are_as_long_as_there_are_atoms():
    with pytest.raises(ValueError, match="atoms_ever.*a column for each of the 2 atoms"):
        record(0, 0, POT, [1, 2, 3], [0, 0])
    assert predicate_of("(In milk_1 basket_1_contain_region)") == "In"
