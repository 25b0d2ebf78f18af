"""YAML files: those of the package, and those of users, with the line of each value; nothing in them is executed."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from libero_env.errors import InvalidInputError
from libero_env.storage.files import read_bounded

MAX_YAML_BYTES = 4 << 20
_MAX_NODES = 200_000  # of a document, each alias counted as often as it is used
_MAX_DEPTH = 60


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc] # C is eight times as fast
    """Booleans are those of YAML 1.2: `On`, `off`, `yes` and `No` are words."""

    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":bool") or first in "tTfF"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


Key = str | int


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text of this package."""
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


@cache
def read_yaml(path: str) -> Any:
    """Return the content of a YAML file of `libero_env`, by its path there; it is shared, do not change it."""
    return parse_yaml(resources.files("libero_env").joinpath(*path.split("/")).read_text(encoding="utf-8"))


@dataclass(frozen=True)
class YamlFile:
    """The content of a YAML file, with the line of each of its values.

    Attributes:
        source: Name of the file.
        data: Content as plain data.
        lines: Line of each value, from 1, by its path.
    """

    source: str
    data: Any
    lines: Mapping[tuple[Key, ...], int] = field(repr=False)

    def line_of(self, path: Sequence[Key]) -> int | None:
        """Return the line of a value, or of the nearest value around it."""
        for end in range(len(path), -1, -1):
            if (line := self.lines.get(tuple(path[:end]))) is not None:
                return line
        return None

    def at(self, path: Sequence[Key] = ()) -> str:
        """Return `file:line` of a value."""
        line = self.line_of(path)
        return self.source if line is None else f"{self.source}:{line}"


def read_yaml_file(path: str | Path) -> YamlFile:
    """Read a YAML file; see `parse_yaml_text`.

    Raises:
        InvalidInputError: The file is missing, a device, too large, not UTF-8, or not valid YAML.
    """
    path = Path(path)
    try:
        return parse_yaml_text(read_bounded(path, MAX_YAML_BYTES).decode(), str(path))
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path} is not valid YAML: it is not UTF-8 text ({error})") from error


def parse_yaml_text(text: str, source: str = "<string>") -> YamlFile:
    """Return the content of a YAML text; nothing in it is executed.

    Aliases may be used, but not so that the content grows beyond what a person writes.

    Args:
        text: One YAML document.
        source: Name of its file, for error messages.

    Raises:
        InvalidInputError: The text is not valid YAML, has a key twice, is nested too deeply, or grows too large by its
            aliases; the message starts with file:line.
    """
    loader = _Loader(text)
    try:
        _check_depth(text, source)
        node = loader.get_single_node()
        if node is None:
            return YamlFile(source, None, {(): 1})
        _check_size(node, source)
        lines: dict[tuple[Key, ...], int] = {}
        _collect_lines(node, (), lines, source)
        return YamlFile(source, loader.construct_document(node), lines)
    except InvalidInputError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{source}:{mark.line + 1}" if mark else source
        raise InvalidInputError(f"{where}: not valid YAML: {error.problem or error.context}") from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidInputError(f"{source}: not valid YAML: {' '.join(str(error).split())}") from None
    finally:
        loader.dispose()


def _check_depth(text: str, source: str) -> None:
    """Check the nesting of a text before its content is built: loaders in C have no limit of their own."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise InvalidInputError(f"{source}: lists within lists, more than {_MAX_DEPTH} deep")


def _check_size(node: yaml.Node, source: str) -> None:
    """Check that a document without its aliases has a usual size, and that none contains itself."""
    sizes: dict[int, float] = {}

    def size(one: yaml.Node) -> float:
        if id(one) in sizes:
            return sizes[id(one)]
        sizes[id(one)] = math.inf  # while it is counted: it would contain itself
        sizes[id(one)] = 1 + sum(map(size, _parts(one)))
        return sizes[id(one)]

    if size(node) > _MAX_NODES:
        raise InvalidInputError(
            f"{source}: with its aliases it has more than {_MAX_NODES} values; write out what is meant"
        )


def _parts(node: yaml.Node) -> Collection[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else ()


def _collect_lines(
    node: yaml.Node, path: tuple[Key, ...], lines: dict[tuple[Key, ...], int], source: str
) -> None:
    """Note the line of each value; raise where a mapping has a key twice, of which YAML would take the last."""
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for index, part in enumerate(node.value):
            _collect_lines(part, (*path, index), lines, source)
        return
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
            continue
        if key.value in seen:
            line = key.start_mark.line + 1
            raise InvalidInputError(f"{source}:{line}: the key {key.value} occurs twice; keep one of them")
        seen.add(key.value)
        lines[(*path, key.value)] = key.start_mark.line + 1
        _collect_lines(value, (*path, key.value), lines, source)
