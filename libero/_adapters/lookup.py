"""Entries of the original's registries by name, and its modules that have no file here."""

import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from libero_env.errors import UnknownNameError


def lookup(table: Mapping[str, Any], kind: str, name: str) -> Any:
    """Return the entry of a name, ignoring case; raise an UnknownNameError, which lists the valid names."""
    for key, value in table.items():
        if key.lower() == str(name).lower():
            return value
    raise UnknownNameError(kind, name, table)


def alias_modules(package: str, modules: str) -> None:
    """Make a package importable by the paths of the original's modules in it, such as `arenas.table_arena`, too.

    Args:
        package: Name of the package, which has the names of all these modules.
        modules: Names of the modules, separated by blanks.
    """
    whole = sys.modules[package]
    for name in modules.split():
        sys.modules[f"{package}.{name}"] = whole
        setattr(whole, name, whole)


class Named:
    """A class with read-only properties from a table, `class Arm(Named, names=TABLE)`.

    The table has names of the original or of robosuite -> function of the instance that returns the value.
    """

    def __init_subclass__(cls, names: Mapping[str, Callable[[Any], Any]] | None = None, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        for name, function in (names or {}).items():
            shown = property(function)
            shown.__set_name__(cls, name)  # type: ignore[attr-defined]  # messages have the name
            setattr(cls, name, shown)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
