"""Where the definition of a task stands: its file with lines, and what files it may name."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError
from libero_env.storage import read_yaml_file
from libero_env.tasks.task import MAX_NAME_BYTES
from libero_env.validation import Key, LineOf

MAX_FILES = 20  # each of which is the scene of the one before


@dataclass(frozen=True)
class Source:
    """Where a definition stands.

    Attributes:
        name: File, or another name for messages.
        folder: Folder that the file of a scene is relative to.
        root: Folder that it must lie in; None for any, in a call from Python.
        files: Files that led here, each the scene of the one before.
        line_of: Function that returns the line of a path of keys; None where there are no lines.
    """

    name: str
    folder: Path = field(default_factory=Path)
    root: Path | None = None
    files: tuple[Path, ...] = ()
    line_of: LineOf | None = None

    def line(self, *path: Key) -> int:
        """Return the line of a path of keys, from 1."""
        return (self.line_of(path) if self.line_of else None) or 1

    def at(self, *path: Key) -> str:
        """Return `file:line` of a path of keys; the name where there are no lines."""
        return f"{self.name}:{self.line(*path)}" if self.line_of else self.name

    def shared_with(self, own: Sequence[Key], index: int) -> LineOf | None:
        """Return the lines of one of the tasks of the file: its own keys are below `tasks`, the others are shared."""
        if (line_of := self.line_of) is None:
            return None
        return lambda path: line_of(("tasks", index, *path) if not path or path[0] in own else path)


def read_definition(path: Path, source: Source | None = None) -> tuple[dict[str, Any], Source]:
    """Return the content of a task's or scene's YAML file, and where it stands.

    Args:
        source: Definition that names the file as its scene; None for none.

    Raises:
        InvalidInputError: The file is missing, is not valid YAML, has no keys, or is its own scene.
    """
    files = source.files if source else ()
    resolved = path.resolve()
    if source and (resolved in files or len(files) >= MAX_FILES):
        names = " -> ".join(file.name for file in (*files, resolved)[-4:])
        raise InvalidInputError(f"{source.at('scene')}: scenes include each other without end: {names}")
    content = read_yaml_file(path)
    if not isinstance(content.data, dict):
        raise InvalidInputError(f"{content.at()}: expected keys such as scene, objects, place and goal")
    if wrong := [key for key in content.data if not isinstance(key, str)]:
        raise InvalidInputError(f"{content.at()}: the key {wrong[0]!r:.60} is not a text")
    root = source.root if source and source.root else path.parent
    return content.data, Source(str(path), path.parent, root, (*files, resolved), content.line_of)


def scene_file(name: str, source: Source) -> Path:
    """Return the file of a scene that a definition names.

    Raises:
        InvalidInputError: The file is missing, or is not in the folder of the task's file.
    """
    path, at = source.folder / name, source.at("scene")
    if not name.isprintable() or len(name.encode()) > MAX_NAME_BYTES:
        raise InvalidInputError(f"{at}: its scene {name!r:.80} is not the name of a file")
    if source.root is not None and not path.resolve().is_relative_to(source.root.resolve()):
        raise InvalidInputError(
            f"{at}: its scene {name} is not in the folder of the task's file, {source.root}; put a copy there, and "
            "give its name"
        )
    if not path.is_file():
        raise InvalidInputError(f"{at}: its scene {path} is missing")
    return path


class Trace:
    """Notes where atoms and regions come from, for errors that are found when all files are merged.

    Args:
        source: Source of the task, for what is not noted.
    """

    def __init__(self, source: Source):
        self.source = source
        self._notes: dict[str, tuple[Source, tuple[Key, ...]]] = {}

    def note(self, label: str, source: Source, *path: Key) -> None:
        """Note where something stands; the first note about it counts."""
        self._notes.setdefault(label, (source, path))

    def of(self, label: str, *otherwise: Key) -> tuple[str, int]:
        """Return the file and line of what was noted, or of a key of the task."""
        source, path = self._notes.get(label, (self.source, otherwise))
        return source.name, source.line(*path)

    def at(self, label: str, *otherwise: Key) -> str:
        """Return `file:line` of what was noted, or of a key of the task."""
        source, path = self._notes.get(label, (self.source, otherwise))
        return source.at(*path)
