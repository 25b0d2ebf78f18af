"""What a step is worth, from the truth of the goal and its atoms.

`sparse`: 1 in the step that reaches the goal, else 0. `staged`: with n atoms of which k hold, and progress s towards
the first that does not,

    r = (k + s) / n,   s = 0.3 (1 - tanh(5 |ee - x|)) + 0.6 p,

at most 0.99, and 1 where the goal holds. x is what has to be moved, metres. p is 1 - tanh(5 |x - target|) for placing
it, for joints the share of the way from the opposite state to the wanted one, for lifting the share of the height.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.sim.scene import zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

REWARDS = ("sparse", "staged")
_OPPOSITE = {"open": "close", "close": "open", "turnon": "turnoff", "turnoff": "turnon"}
_REACH, _MOVE = 0.3, 0.6
_BEST_WITHOUT_SUCCESS = 0.99


@dataclass(frozen=True)
class Reward:
    """A reward by name.

    Attributes:
        kind: `sparse` or `staged`.
        scale: what success is worth.

    Raises:
        UnknownNameError: no such kind.
    """

    kind: str = "sparse"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in REWARDS:
            raise UnknownNameError("reward", self.kind, REWARDS)

    def __call__(
        self, view: StateView, success: bool, atoms: Sequence[Atom] = (), holds: Sequence[bool] = ()
    ) -> float:
        """Reward of a state; `holds` says which of the goal's atoms are true."""
        if success or self.kind == "sparse":
            return self.scale * float(success)
        return self.scale * staged(view, atoms, holds)


def staged(view: StateView, atoms: Sequence[Atom], holds: Sequence[bool]) -> float:
    """The staged reward of a state that does not reach the goal, in [0, 0.99]."""
    missing = [atom for atom, true in zip(atoms, holds, strict=True) if not true]
    towards = approach(view, missing[0]) if missing else 0.0
    return min((len(atoms) - len(missing) + towards) / max(len(atoms), 1), _BEST_WITHOUT_SUCCESS)


def approach(view: StateView, atom: Atom) -> float:
    """Progress towards an atom that does not hold, in [0, 0.9]; 0 for what this module knows nothing of."""
    kind = atom.predicate.lower()
    if kind in ("on", "in", "stack", "incontact") and len(atom.args) == 2:
        moved = place(view, atom.args[0])
        done = _near(moved, place(view, atom.args[1]))
    elif kind in _OPPOSITE and len(atom.args) == 1:
        moved, done = place(view, atom.args[0]), joint_share(view, atom.args[0], kind)
    elif kind == "up" and len(atom.args) == 1:
        moved = place(view, atom.args[0])
        done = float(np.clip(moved[2], 0.0, 1.0))  # it counts from one metre on
    else:
        return 0.0
    return _REACH * _near(view.eef_pos, moved) + _MOVE * done


def place(view: StateView, name: str) -> np.ndarray:
    """Where an object, fixture or region is, (3,), world frame."""
    if view.is_thing(name):
        return view.body_pos(name)
    region = view.scene.problem.region(name)
    if region is not None and region.ranges:
        return zone_boxes(region, view.scene.workspace)[0][0]
    if mujoco.mj_name2id(view.scene.model, mujoco.mjtObj.mjOBJ_SITE, name) < 0:
        raise UnknownNameError("object, fixture or region", name, view.scene.entities)
    return view.site_pos(name)


def joint_share(view: StateView, address: str, state: str) -> float:
    """Share of the way that joints have come to a state such as `open`, in [0, 1]; where all count, of the last one."""
    owner = view.scene.owner(address)
    ranges: Mapping[str, tuple[float, float]] = view.scene.entities[owner].articulation if owner else {}
    values = np.array(list(view.joint_positions(address).values()))
    if state not in ranges or _OPPOSITE[state] not in ranges or not values.size:
        return 0.0
    wanted, opposite = np.array(ranges[state]), np.array(ranges[_OPPOSITE[state]])
    start = opposite[
        np.abs(opposite - wanted.mean()).argmax()
    ]  # the far end of one, the near end of the other
    end = wanted[np.abs(wanted - opposite.mean()).argmin()]
    shares = np.clip((values - start) / (end - start), 0.0, 1.0)
    return float(shares.max() if state in ("open", "turnon") else shares.min())


def _near(a: np.ndarray, b: np.ndarray) -> float:
    return float(1.0 - np.tanh(5.0 * np.linalg.norm(a - b)))
