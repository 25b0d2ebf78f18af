"""Rewards, from whether the goal holds and which of its atoms do.

`sparse`: 1 in the step that reaches the goal, else 0. `staged`: with n atoms of which k are true, and progress s
towards the first that is false,

    r = (k + s) / n,   s = 0.3 (1 - tanh(5 |ee - x|)) + 0.6 p,

at most 0.99, and 1 where the goal is true. x is the position of the entity to move, m. p is 1 - tanh(5 |x - target|)
for placing it, for joints the fraction of the way from the opposite state to the required one, for lifting the
fraction of the height.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from libero_env.errors import require_known
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.predicates import region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

REWARDS = ("sparse", "staged")
_REACH_WEIGHT, _MOVE_WEIGHT = 0.3, 0.6
_BEST_WITHOUT_SUCCESS = 0.99


@dataclass(frozen=True)
class Reward:
    """A reward function by name.

    Attributes:
        kind: `sparse` or `staged`.
        scale: Reward of success.

    Raises:
        UnknownNameError: The kind does not exist.
    """

    kind: str = "sparse"
    scale: float = 1.0

    def __post_init__(self) -> None:
        require_known("reward", self.kind, REWARDS)

    def __call__(
        self, view: StateView, success: bool, atoms: Sequence[Atom] = (), held: Sequence[bool] = ()
    ) -> float:
        """Return the reward of a state.

        Args:
            success: Whether the goal is true.
            held: Whether each atom holds.
        """
        if success or self.kind == "sparse":
            return self.scale * float(success)
        return self.scale * staged_reward(view, atoms, held)


def staged_reward(view: StateView, atoms: Sequence[Atom], held: Sequence[bool]) -> float:
    """Return the staged reward of a state that does not reach the goal, in [0, 0.99]."""
    missing = [atom for atom, holds in zip(atoms, held, strict=True) if not holds]
    progress = atom_progress(view, missing[0]) if missing else 0.0
    return min((len(atoms) - len(missing) + progress) / max(len(atoms), 1), _BEST_WITHOUT_SUCCESS)


def atom_progress(view: StateView, atom: Atom) -> float:
    """Return the progress towards an atom that is false, in [0, 0.9]; 0 for predicates without a known measure."""
    kind = atom.predicate.lower()
    if kind in ("on", "in", "stack", "incontact") and len(atom.args) == 2:
        moved = position_of(view, atom.args[0])
        done = _closeness(moved, position_of(view, atom.args[1]))
    elif kind in OPPOSITE_STATES and len(atom.args) == 1:
        moved, done = position_of(view, atom.args[0]), joint_progress(view, atom.args[0], kind)
    elif kind == "up" and len(atom.args) == 1:
        moved = position_of(view, atom.args[0])
        done = float(np.clip(moved[2], 0.0, 1.0))  # `up` is true from one metre on
    else:
        return 0.0
    return _REACH_WEIGHT * _closeness(view.eef_pos, moved) + _MOVE_WEIGHT * done


def position_of(view: StateView, name: str) -> np.ndarray:
    """Return the position of an object, fixture or region, (3,), world frame, m.

    Raises:
        UnknownNameError: The object, fixture or region does not exist.
    """
    return view.body_pos(name) if view.is_entity(name) else region_boxes(view, name)[0].centre


def joint_progress(view: StateView, address: str, state: str) -> float:
    """Return the fraction of the way that joints have moved to a state, in [0, 1].

    It is that of the most advanced joint for states that one joint suffices for, else of the least advanced.

    Args:
        address: Name of an object or fixture, or address of a region.
        state: `open`, `close`, `turnon` or `turnoff`.
    """
    owner = view.scene.owner(address)
    ranges: Mapping[str, tuple[float, float]] = view.scene.entities[owner].articulation if owner else {}
    values = np.array(list(view.joint_positions(address).values()))
    if state not in ranges or OPPOSITE_STATES[state] not in ranges or not values.size:
        return 0.0
    required, opposite = np.array(ranges[state]), np.array(ranges[OPPOSITE_STATES[state]])
    # The far end of the opposite range, and the near end of the required one.
    start = opposite[np.abs(opposite - required.mean()).argmax()]
    end = required[np.abs(required - opposite.mean()).argmin()]
    fractions = np.clip((values - start) / (end - start), 0.0, 1.0)
    return float(fractions.max() if state in ("open", "turnon") else fractions.min())


def _closeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(1.0 - np.tanh(5.0 * np.linalg.norm(a - b)))
