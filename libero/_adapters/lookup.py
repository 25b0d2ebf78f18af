"""Entries of the original's registries by name, and its modules that have no file here."""

import sys
from collections.abc import Mapping
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
