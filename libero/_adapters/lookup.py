"""Entries of the original's registries by name, and its modules that have no file here."""

import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from libero_env.errors import UnknownNameError


def lookup(table: Mapping[str, Any], kind: str, name: str) -> Any:
    """Return the entry of a name, ignoring case; raise an UnknownNameError, which lists the valid names."""
    for key, value in table.items():
        if key.lower() == str(name).lower():
            return value
    raise UnknownNameError(kind, name, table)


def alias_modules(package: str, **modules: str) -> None:
    """Make names of a package importable from modules of the original, such as `arenas.table_arena`, too.

    Args:
        package: Name of the package, which has the names.
        modules: Module of the original -> names in it, separated by blanks.
    """
    whole = sys.modules[package]
    for module, names in modules.items():
        alias = ModuleType(f"{package}.{module}", f"Path of the original; see `{package}`.")
        vars(alias).update({name: getattr(whole, name) for name in names.split()})
        sys.modules[alias.__name__] = alias
        setattr(whole, module, alias)
