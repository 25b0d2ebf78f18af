"""Events: when a perturbation begins during an episode instead of at its start.

A trigger is a number of control steps since the reset (`step40`), a share of the horizon (`25%`), or a phase of an
object that the goal is about: `touched`, `lifted` or `over_goal`. Before it, nothing differs.
"""

import re
from typing import TYPE_CHECKING

from libero_env.errors import InvalidInputError, UnknownNameError

if TYPE_CHECKING:
    from libero_env.sim.watch import EpisodeWatch

PHASES = ("touched", "lifted", "over_goal")
NEVER = -1  # step of an event that has not happened
_AT = re.compile(r"step\d{1,9}|[1-9]?\d%")


def checked_trigger(text: str) -> str:
    """Return a trigger; empty for none.

    Raises:
        UnknownNameError: There is none of this name.
    """
    if text and text not in PHASES and not _AT.fullmatch(text):
        raise UnknownNameError("trigger", text, (*PHASES, "step40", "25%"))
    return text


def require_moment(trigger: str, horizon: int) -> None:
    """Raise an `InvalidInputError` where a trigger is a step that no episode has."""
    if trigger.startswith("step") and int(trigger.removeprefix("step")) >= horizon:
        raise InvalidInputError(
            f"event @{trigger}: an episode has the steps 0 to {horizon - 1}; expected one of these, or a longer horizon"
        )


def has_begun(trigger: str, steps: int, horizon: int, watch: "EpisodeWatch", i: int) -> bool:
    """Return whether the moment of a trigger has come in simulation i.

    Args:
        trigger: Trigger that has been checked.
        steps: Number of control steps since the reset.
        horizon: Number of control steps after which the episode ends.
        watch: Traces of the episodes.
        i: Index of the simulation.
    """
    if trigger.startswith("step"):
        return steps >= int(trigger.removeprefix("step"))
    if trigger.endswith("%"):
        return 100 * steps >= int(trigger.removesuffix("%")) * horizon
    trace = watch.traces[i]
    if trigger == "over_goal":
        from libero_env.sim.watch import over  # with MuJoCo

        return any(atom.args[0] == trace.in_hand and over(watch.views[i], atom) for atom in watch.goals[i])
    names = trace.touched if trigger == "touched" else trace.lifted
    return any(name in names for name in watch.wanted(i))
