"""Why an episode failed: what it has shown of each object, and the decision tree that names one cause.

A `Trace` is filled by `libero_env.sim.watch.EpisodeWatch` after each control step. Its names are objects and fixtures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from pydantic import Field

Cause = Literal[
    "forbidden",
    "wrong order",
    "undone",
    "not released",
    "wrong place",
    "dropped",
    "out of time",
    "collided",
    "wrong object",
    "missed grasp",
    "never reached",
]
CAUSES: tuple[Cause, ...] = get_args(Cause)
HARD = 100.0  # [N] normal force from which a contact of the robot is a collision

_Name = Annotated[str, Field(max_length=1000)]


@dataclass(frozen=True)
class Failure:
    """Why an episode failed.

    Attributes:
        cause: One of `CAUSES`.
        of: Object or fixture of the goal that it is about; empty where no atom of the goal is missing.
        what: What the robot collided with, what it lifted, moved or closed its fingers at instead, where the object is,
            or the condition over time that was broken; otherwise empty.
        newtons: Largest normal force of a collision; otherwise 0.
        handled: Objects that were lifted, and fixtures whose joints were moved.
        instead: Atoms about these that held at the end, and are no part of the goal.
    """

    cause: Cause
    of: _Name = ""
    what: _Name = ""
    newtons: Annotated[float, Field(ge=0)] = 0.0
    handled: tuple[_Name, ...] = ()
    instead: tuple[_Name, ...] = ()


@dataclass
class Trace:
    """What an episode has shown so far.

    Attributes:
        steps: Number of control steps.
        touched: Objects and fixtures that the gripper has touched.
        touching: Those that it touches now.
        in_hand: Object that both fingers have touched last, while a finger still touches it.
        held: Last step in which each object was in both fingers.
        lifted: Objects that were raised in the fingers.
        slipped: Of the lifted objects that left the fingers: whether these had not opened.
        shut_at: Objects that were nearest to the fingertips, and within 6 cm, while the fingers shut on nothing.
        impacts: Collisions: step, with what, and the normal force [N].
    """

    steps: int = 0
    touched: set[str] = field(default_factory=set)
    touching: set[str] = field(default_factory=set)
    in_hand: str | None = None
    held: dict[str, int] = field(default_factory=dict)
    lifted: dict[str, None] = field(default_factory=dict)
    slipped: dict[str, bool] = field(default_factory=dict)
    shut_at: dict[str, None] = field(default_factory=dict)
    impacts: list[tuple[int, str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Missing:
    """An atom of the goal that does not hold at the end.

    Attributes:
        of: Object or fixture that it is about.
        has_held: Whether it held at any time.
        is_over: Whether the object is over or in the place where it belongs.
        place: What the object touches; empty while it is in the air.
    """

    of: str
    has_held: bool = False
    is_over: bool = False
    place: str = ""


def explain(
    trace: Trace, missing: Sequence[Missing], wanted: Sequence[str], astray: Sequence[str] = ()
) -> Failure:
    """Return why an episode failed.

    Of each missing atom the first that is true: the atom held before (undone); the object is in the hand, over its
    place (not released) or elsewhere (out of time); it was lifted, and still falls into its place (out of time), or has
    left fingers that had not opened (dropped) or had (wrong place); the gripper still touches the object, or moves the
    fixture (out of time); the robot has hit something else since it last held the object (collided); it has lifted an
    object that the goal is not about (wrong object); it has touched the object, or its fingers have shut beside it
    (missed grasp); it has gone astray (wrong object); or none of these (never reached). Of several missing atoms, the
    one whose cause is first in `CAUSES` is named.

    Args:
        trace: What the episode has shown.
        missing: Atoms of the goal that do not hold at its end.
        wanted: Objects and fixtures of all atoms of the goal.
        astray: What no atom names and the gripper has moved, held, or closed at; the most telling last.
    """
    found = [_explain(trace, one, wanted, astray) for one in missing] or [Failure("out of time")]
    return min(found, key=lambda one: CAUSES.index(one.cause))


def _explain(trace: Trace, one: Missing, wanted: Sequence[str], astray: Sequence[str]) -> Failure:
    of, since = one.of, trace.held.get(one.of, -1)
    hits = [(newtons, what) for step, what, newtons in trace.impacts if step > since and what != of]
    others = [name for name in trace.lifted if name not in wanted]
    if one.has_held:
        return Failure("undone", of, one.place)
    if trace.in_hand == of:
        return Failure("not released" if one.is_over else "out of time", of)
    if of in trace.slipped and one.is_over and not one.place:
        return Failure("out of time", of)  # it still falls
    if of in trace.slipped:
        return Failure("dropped" if trace.slipped[of] else "wrong place", of, one.place)
    if of in trace.touching and not hits:
        return Failure("out of time", of)
    if hits:
        newtons, what = max(hits)
        return Failure("collided", of, what, newtons)
    if not others and (of in trace.touched or of in trace.shut_at):
        return Failure("missed grasp", of)
    if others or astray:
        return Failure("wrong object", of, [*astray, *others][-1])
    return Failure("never reached", of)
