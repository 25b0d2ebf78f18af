"""Predicates of task files: how many arguments each takes, and of which kinds."""

import inspect
from collections.abc import Callable

Kinds = frozenset[str]  # of `object`, `fixture`, `workspace` and `region`

_ENTITY = frozenset({"object", "fixture"})
_PLACE = _ENTITY | {"region"}
_SOLID = _ENTITY | {"workspace"}
ANY = _PLACE | {"workspace"}

KINDS: dict[str, tuple[Kinds, ...]] = {
    "On": (_ENTITY, _PLACE),
    "In": (_ENTITY, frozenset({"region"})),
    "Stack": (_ENTITY, _PLACE),
    "Up": (_ENTITY,),
    "Open": (_PLACE,),
    "Close": (_PLACE,),
    "Turnon": (_PLACE,),
    "Turnoff": (_PLACE,),
    "Incontact": (_SOLID, _SOLID),
    "Printjointstate": (_PLACE,),
}
"""Predicate -> kinds that each of its arguments may have; predicates that are not in it take anything."""


def declare(predicate: str, function: Callable[..., bool]) -> None:
    """Set the number of arguments of a predicate from those of its function, of any kind.

    Args:
        predicate: Name of the predicate, capitalised.
        function: Function of a state and of the arguments. One that takes any number of them may have any number.
    """
    KINDS.pop(predicate, None)
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # of some functions in C
        return
    plain = all(
        p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters
    )
    if plain and len(parameters) > 1:
        KINDS[predicate] = (ANY,) * (len(parameters) - 1)
