"""Names of workspaces, what tasks take place on: those of the benchmark, and those in the user's folder of objects."""

import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Literal, get_args

from libero_env.paths import objects_dir

BuiltinWorkspace = Literal[
    "table", "kitchen_table", "living_room_table", "study_table", "coffee_table", "floor"
]
BUILTIN_WORKSPACES: tuple[str, ...] = get_args(BuiltinWorkspace)
FILE = "workspace.yaml"


class _Workspaces(Collection[str]):
    """Names of all workspaces; one of the user's is there as soon as its file is."""

    def __contains__(self, name: object) -> bool:
        return name in BUILTIN_WORKSPACES or find_workspace(str(name)) is not None

    def __iter__(self) -> Iterator[str]:
        own = (path.parent.name for path in objects_dir().glob(f"*/{FILE}"))
        return iter((*BUILTIN_WORKSPACES, *sorted(filter(find_workspace, own))))

    def __len__(self) -> int:
        return len(tuple(iter(self)))


WORKSPACES = _Workspaces()
"""Categories of the fixtures that a task takes place on, see `libero_env.assets.arena`."""


def find_workspace(name: str) -> Path | None:
    """Return the folder of a user's workspace; None where there is none of this name."""
    return objects_dir() / name if name not in BUILTIN_WORKSPACES and is_described(name) else None


def is_described(name: str) -> bool:
    """Return whether the user's folder of objects describes a workspace of this name."""
    return name.isidentifier() and os.path.isfile(objects_dir() / name / FILE)
