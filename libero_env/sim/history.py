"""Conditions over time: what the goal of an episode remembers of the moments that have been looked at.

Moments are the reset and the end of each control step. At moment t, with t = 0 at the reset:

    (Then A B)    B holds, and at some s < r also A did; r is the first moment from which on B has held until t
    (Never A)     A has held at no moment s <= t
    (Count n A)   there are at least n moments 0 < s <= t at which A holds and did not hold at s - 1

Looking at a moment again changes nothing.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from libero_env.tasks.expression import Atom, Count, Expression, Never, Not, Or, Then

# of the second part of a Then that holds: whether the first had held before it began to
_LATE, _IN_ORDER = 1, 2


class History:
    """Memory of the conditions over time of a goal in several episodes.

    Args:
        goal: Goal without quantifiers.
        num: Number of episodes.

    Attributes:
        memory: Two numbers for each condition over time, (num, conditions, 2): of Then, whether the first part has
            held, and how the second holds; of Never, whether the part has held; of Count, how often it began to, and
            whether it holds.
    """

    def __init__(self, goal: Expression, num: int):
        self.goal = goal
        self._places = {node: k for k, node in enumerate(dict.fromkeys(over_time(goal)))}
        self._begin = [[0.0, float(isinstance(node, Count))] for node in self._places]
        self.memory = np.zeros((num, len(self._places), 2))
        self.begin(range(num))

    def begin(self, ids: Sequence[int] | np.ndarray) -> None:
        """Begin episodes: nothing has been looked at."""
        self.memory[np.asarray(ids, np.int64)] = np.reshape(self._begin, (-1, 2))

    def look(
        self, ids: np.ndarray, held: Mapping[Atom, np.ndarray], node: Expression | None = None
    ) -> np.ndarray:
        """Return whether the goal, or a part of it, holds in the present moment of episodes, (k,) bool.

        Args:
            ids: Indices of the episodes, (k,).
            held: Whether each atom holds now, (k,).
            node: Part of the goal.
        """

        def holds(node: Expression, parts: Iterator[np.ndarray]) -> np.ndarray:
            match node:
                case Atom():
                    return held[node]
                case Or():
                    return np.any([np.zeros(len(ids), bool), *parts], axis=0)
                case Not():
                    return ~next(parts)
                case Then() | Never() | Count():
                    return self._over_time(ids, node, *parts)
            return np.all([np.ones(len(ids), bool), *parts], axis=0)

        return (self.goal if node is None else node).fold(holds)

    def missing(self, i: int, held: Mapping[Atom, bool]) -> list[Expression]:
        """Return what an episode lacks now: atoms that have to become true, and conditions that are broken.

        Broken are a Never whose part has held, and a Then whose second part holds too early.
        """
        values = {atom: np.array([holds]) for atom, holds in held.items()}

        def visit(node: Expression) -> Iterator[Expression]:
            if self.look(np.array([i]), values, node)[0]:
                return
            if isinstance(node, Atom | Never) or (isinstance(node, Then) and self.is_late(i, node)):
                yield node
            elif isinstance(node, Then):
                yield from visit(node.parts[self.count(i, node)])
            elif not isinstance(node, Not):
                for part in node.children:
                    yield from visit(part)

        return list(visit(self.goal))

    def count(self, i: int, node: Expression) -> int:
        """Return how often the part of a Count became true in an episode; of Then and Never, whether the first held."""
        return int(self.memory[i, self._places[node], 0])

    def is_late(self, i: int, node: Then) -> bool:
        """Return whether the second part of a Then holds in an episode since before the first did."""
        return bool(self.memory[i, self._places[node], 1] == _LATE)

    def _over_time(self, ids: np.ndarray, node: Expression, *parts: np.ndarray) -> np.ndarray:
        """Note a moment of a condition over time, and return whether it holds."""
        k = self._places[node]
        first, second = self.memory[ids, k].T
        match node:
            case Then():
                began = np.where(first > 0, _IN_ORDER, _LATE)
                second = np.where(parts[1], np.where(second > 0, second, began), 0)
                first = np.maximum(first, parts[0])
                found = second == _IN_ORDER
            case Count(number):
                first, second = first + (parts[0] & (second == 0)), parts[0].astype(float)
                found = first >= number
            case _:
                first = np.maximum(first, parts[0])
                found = first == 0
        self.memory[ids, k] = np.stack([first, second], axis=1)
        return found


def over_time(goal: Expression) -> Iterator[Expression]:
    """Yield the conditions over time that a goal has, inner ones first."""
    for part in goal.children:
        yield from over_time(part)
    if isinstance(goal, Then | Never | Count):
        yield goal
