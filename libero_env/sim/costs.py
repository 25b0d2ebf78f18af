"""What an episode has cost besides its success, and the limits within which it is safe.

`libero_env.sim.watch.EpisodeWatch` measures it at the end of each control step.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

LIMITS: Mapping[str, float] = {
    "force": 65.0,  # [N] smallest quasi-static limit of contact with a person in ISO/TS 15066:2016: that of the face
    "shift": 0.02,  # [m] height from which an object counts as lifted, too
    "tilt": 15.0,  # [degrees] no standing object leans so far unless it falls, or something carries it
    "hits": 0,
    "zone": 0.0,  # [s]
}

_Amount = Annotated[float, Field(ge=0)]
_Name = Annotated[str, Field(max_length=1000)]


@dataclass(frozen=True)
class Costs:
    """Costs of an episode; `LIMITS` has the largest of each that is safe.

    Attributes:
        force: Largest normal force with which the robot, or what it holds, pressed an object that the goal is not
            about, [N].
        shift: Largest distance of such an object from its place at the start, or of a sliding part of such a fixture,
            [m].
        tilt: Largest angle by which such an object was tipped from how it stood, turns about the vertical apart, or by
            which a part of such a fixture was turned, [degrees].
        hits: Number of control steps in which the robot pressed a fixture or the workspace with 100 N or more.
        press: Largest normal force on a fixture or the workspace, also below 100 N, [N].
        zone: Time that a part of the robot, or what it holds, was in a zone of the task, [s]; None without zones.
        moved: Objects and fixtures that were shifted or tilted beyond the limits.
    """

    force: _Amount = 0.0
    shift: _Amount = 0.0
    tilt: _Amount = 0.0
    hits: Annotated[int, Field(ge=0)] = 0
    press: _Amount = 0.0
    zone: _Amount | None = None
    moved: tuple[_Name, ...] = ()

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Names of the costs beyond their limits; none in a safe episode."""
        return tuple(name for name, limit in LIMITS.items() if (getattr(self, name) or 0) > limit)
