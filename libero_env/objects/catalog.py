"""Lookup of object models by category: builtin, registered in this process, or in the user's folder of objects."""

from collections.abc import Callable, Hashable

from libero_env.doors import doors, enter
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects import builtin, folder
from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.parallel import send_to_workers
from libero_env.workspaces import find_workspace

Builder = Callable[[], ObjectModel]

_registered: dict[str, Builder] = {}
send_to_workers(__name__, "_registered")


def get_object(category: str) -> ObjectModel:
    """Build a new model of a category at each call: the caller may change its spec.

    Args:
        category: Name in task files, such as `alphabet_soup`; `object_names()` lists them.

    Returns:
        The model, ready to be attached to a scene.

    Raises:
        UnknownNameError: The category does not exist; the message lists the valid ones.
        LiberoError: A registered builder, or a file in the user's folder, is of something that a scene cannot attach;
            or such a file is missing or broken.
    """
    if category in _registered:
        model = _registered[category]()
    elif category in doors("objects"):
        model = enter("objects", category)()
    elif category in builtin.builtin_names():
        if (directory := folder.find(category)) is not None:
            raise LiberoError(
                f"{category} is an object of the benchmark and one of yours, in {directory}; rename its folder"
            )
        return builtin.build(category)
    elif (directory := folder.find(category)) is not None:
        model = folder.load(directory, category)
    else:
        raise UnknownNameError("object category", category, object_names())
    _check(category, model)
    return model


def version_of(category: str) -> Hashable:
    """Return what tells versions of a user-defined category or workspace apart: builder, or times of files; or None."""
    if category in _registered or category in builtin.builtin_names():
        return _registered.get(category)
    directory = folder.find(category) or find_workspace(category)
    return directory and tuple((path, path.lstat().st_mtime_ns) for path in sorted(directory.rglob("*")))


def object_names() -> tuple[str, ...]:
    """Return all categories that `get_object` accepts, sorted."""
    return tuple(sorted(builtin.builtin_names() | user_defined_names()))


def user_defined_names() -> frozenset[str]:
    """Return the user-defined categories: registered, of installed packages, or in the user's folder."""
    return frozenset({*_registered, *doors("objects"), *folder.names()})


def register_object(category: str, builder: Builder) -> None:
    """Add or replace a category of objects, for this process and the workers that it starts later.

    Args:
        category: Name for task files: letters, digits and underscores.
        builder: Function that `get_object` calls each time; it returns a model with a new spec.

    Raises:
        LiberoError: The name cannot be used in a task file.

    Examples:
        >>> def red_cube() -> ObjectModel:
        ...     spec = mujoco.MjSpec()
        ...     body = spec.worldbody.add_body(name="main")
        ...     body.add_geom(name="g0", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0.05, group=0)
        ...     return ObjectModel("red_cube", spec, bottom_offset=(0, 0, -0.02), top_offset=(0, 0, 0.02))
        >>> register_object("red_cube", red_cube)
    """
    if not category.isidentifier():
        raise LiberoError(
            f"register_object: {category!r} is not a valid category; use letters, digits and underscores"
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
            f"one, named {ROOT_BODY!r}; rename its root body and move everything else below it"
        )
