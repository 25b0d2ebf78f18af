"""All kinds of perturbations by name, in the order in which they are applied."""

from collections.abc import Mapping

from libero_env.errors import UnknownNameError
from libero_env.perturbations import actions, looks, observations, problem, starts
from libero_env.perturbations.kind import Kind

KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kinds in (problem.KINDS, looks.KINDS, starts.KINDS, observations.KINDS, actions.KINDS)
    for kind in kinds
}


def get_kind(name: str) -> Kind:
    """Return a kind of perturbation.

    Raises:
        UnknownNameError: It does not exist; the message lists the kinds.
    """
    if name not in KINDS:
        raise UnknownNameError("kind of perturbation", name, KINDS)
    return KINDS[name]
