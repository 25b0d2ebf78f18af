"""Doors to what is loaded by name: `doors.yaml`, and entry points of installed packages. Nothing here imports it.

A package enters by its own `pyproject.toml`, and every command knows it then:

    [project.entry-points."libero.predicates"]
    Near = "my_package:near"
"""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import Any

from libero_env.errors import code_of, require_known
from libero_env.storage import read_yaml


@cache
def doors(kind: str) -> Mapping[str, str]:
    """Return name -> `module:attribute` of a kind; names of this package stay what they are."""
    return {one.name: one.value for one in entry_points(group=f"libero.{kind}")} | read_yaml("doors.yaml")[
        kind
    ]


def enter(kind: str, name: str) -> Any:
    """Import what stands behind a name.

    Raises:
        UnknownNameError: There is no such name.
    """
    require_known(f"name of {kind}", name, doors(kind))
    with code_of(f"the entry point {name} of libero.{kind}"):
        return resolve_name(doors(kind)[name])
