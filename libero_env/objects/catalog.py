"""Category name -> object model: of the builtin pack, of what users registered, of their folder of objects."""

from collections.abc import Callable

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects import folder
from libero_env.objects.builtin import BUILDERS
from libero_env.objects.model import ROOT_BODY, ObjectModel

Builder = Callable[[], ObjectModel]

_registered: dict[str, Builder] = {}


def get_object(category: str) -> ObjectModel:
    """Builds the model of a category, anew at each call: the caller may change its spec.

    Raises:
        UnknownNameError: no object has this name; the message lists the valid ones.
        LiberoError: a registered builder returned something that a scene cannot attach, or a file in the user's
            folder is missing or broken.
    """
    builder = _registered.get(category) or BUILDERS.get(category)
    if builder is None:
        if (place := folder.find(category)) is not None:
            return folder.load(place, category)
        raise UnknownNameError("object category", category, object_names())
    model = builder()
    if category in _registered:
        _check(category, model)
    return model


def object_names() -> tuple[str, ...]:
    """All categories that `get_object` knows, sorted."""
    return tuple(sorted({*BUILDERS, *own_names()}))


def own_names() -> frozenset[str]:
    """The categories that users added: registered in this process, or kept in their folder of objects."""
    return frozenset({*_registered, *folder.names()})


def register_object(category: str, builder: Builder) -> None:
    """Adds a category, or replaces one of the builtin pack, for this process.

    Args:
        category: name to be used in task files: letters, digits and underscores.
        builder: called at each `get_object`; returns a model with a fresh spec.

    Raises:
        LiberoError: the name cannot stand in a task file.
    """
    if not category.isidentifier():
        raise LiberoError(
            f"register_object: {category!r} is no valid category; use letters, digits and underscores"
        )
    _registered[category] = builder


def _check(category: str, model: ObjectModel) -> None:
    if not isinstance(model, ObjectModel):
        raise LiberoError(
            f"object {category!r}: its builder returned {type(model).__name__}, expected ObjectModel"
        )
    names = [body.name for body in model.spec.worldbody.bodies]
    if names != [ROOT_BODY]:
        raise LiberoError(
            f"object {category!r}: the world body of its spec has the children {names}, expected exactly "
            f"one, named {ROOT_BODY!r}; name its root body so and move everything else below it"
        )
