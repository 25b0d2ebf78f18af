"""Entries of the original's registries by name, and its modules that have no file here."""

import sys
from collections.abc import Callable, Mapping
from typing import Any

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


def answers(table: Mapping[str, Callable[[Any], Any]]) -> Callable[[type], type]:
    """Return a decorator that gives a class a read-only property for each entry of a table.

    Args:
        table: Name of the original or of robosuite -> function of the instance that returns its value.
    """

    def decorated(cls: type) -> type:
        for name, function in table.items():
            setattr(cls, name, property(function))
        return cls

    return decorated
