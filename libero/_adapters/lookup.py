"""Entries of the original's registries by name."""

from collections.abc import Mapping
from typing import Any

from libero_env.errors import UnknownNameError


def lookup(table: Mapping[str, Any], kind: str, name: str) -> Any:
    """Return the entry of a name, ignoring case; raise an UnknownNameError, which lists the valid names."""
    for key, value in table.items():
        if key.lower() == str(name).lower():
            return value
    raise UnknownNameError(kind, name, table)
