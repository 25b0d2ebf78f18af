"""Validation of what comes from outside: values against annotated types, YAML with its line numbers.

Types are those of pydantic (`Annotated[float, Field(gt=0)]`, `Literal`, dataclasses, `TypedDict`), read strictly: a
text is no number, a truth is no whole number, numbers are finite. Every fault has a path, the value, what is valid, and
a line where the value comes from a file.
"""

import difflib
import inspect
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

import yaml

from libero_env.errors import InvalidInputError, LiberoError

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter
    from pydantic_core import ErrorDetails

Key = str | int
LineOf = Callable[[Sequence[Key]], int | None]

MAX_YAML_BYTES = 4 << 20
_MAX_NODES = 200_000  # of a document, each alias counted as often as it is used
_MAX_DEPTH = 60
_MAX_WHOLE = 10**300  # whole numbers beyond it count as infinite
_MAX_SHOWN = 80  # characters of a value in a message
_MAX_FAULTS = 4  # in a message
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def validate(
    kind: Any,
    value: Any,
    *,
    source: str = "",
    prefix: Sequence[Key] = (),
    line_of: LineOf | None = None,
    error: type[LiberoError] = InvalidInputError,
) -> Any:
    """Return a value as its type describes it: dataclasses are built, defaults filled in.

    Args:
        kind: Type with pydantic's annotations.
        value: Plain data: mappings, lists, numbers, texts, truths and None.
        source: Name of the file that the value comes from; empty for none.
        prefix: Path of the value in its source, which is shown before the paths in it.
        line_of: Function that returns the line of a path (with the prefix) in the source, from 1.
        error: Type of the error.

    Raises:
        InvalidInputError: A key is unknown or missing, or a value is of another kind or outside of its range; or
            `error`.
    """
    from pydantic import ValidationError

    try:
        # as JSON, where strict means: no conversions between kinds, but keys with values make a dataclass
        return _adapter(kind).validate_json(json.dumps(_plain(value, error)), strict=True)
    except ValidationError as found:
        faults = _faults(found.errors(include_url=False), kind, value)
        raise error(_message(faults, source, tuple(prefix), line_of)) from None


def validate_arguments(
    target: Callable[..., Any],
    arguments: Mapping[str, Any],
    *,
    prefix: Sequence[Key] = (),
    error: type[LiberoError] = InvalidInputError,
) -> None:
    """Check keyword arguments against the annotations in the signature of a function or class.

    Parameters without an annotation, and those whose types are no plain data, take anything. Arguments that are missing
    are no fault: the caller may add them.

    Args:
        target: Function or class.
        arguments: Plain data by the name of the parameter.
        prefix: Path of the arguments, which is shown before their names.
        error: Type of the error.

    Raises:
        InvalidInputError: An argument is unknown, or of another kind or outside of its range; or `error`.
    """
    kind = _arguments_kind(target)
    if kind is not None:
        validate(kind, dict(arguments), prefix=prefix, error=error)


@dataclass(frozen=True)
class Parameters:
    """The keyword parameters of a function or class.

    Attributes:
        types: Annotation of each parameter by its name; `Any` for those without, or whose names cannot be resolved.
        required: Names of the parameters without a default.
        any_key: Whether other names are accepted too (`**kwargs`).
    """

    types: Mapping[str, Any]
    required: frozenset[str]
    any_key: bool


@lru_cache(maxsize=256)
def parameters_of(target: Callable[..., Any]) -> Parameters | None:
    """Return the parameters of a function or class; None where they are not known, as of some builtins."""
    try:
        found = inspect.signature(target).parameters.values()
    except (TypeError, ValueError):
        return None
    try:
        hints = get_type_hints(target.__init__ if inspect.isclass(target) else target, include_extras=True)
    except (NameError, TypeError, AttributeError):  # names that exist for type checkers only
        hints = {}
    named = [p for p in found if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    return Parameters(
        types={p.name: hints.get(p.name, Any) for p in named},
        required=frozenset(p.name for p in named if p.default is p.empty),
        any_key=any(p.kind is p.VAR_KEYWORD for p in found),
    )


class OneOf:
    """Annotation of a text that is one of several names: `Annotated[str, OneOf(names)]`.

    For names that are known at run time only; otherwise use `Literal`.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that pydantic checks."""
        from pydantic_core import core_schema

        return core_schema.literal_schema(list(self.names))


def accepted(kind: Any) -> str:
    """Return in words which values a type takes, such as `whole number, at least 1`; empty where that is not known."""
    return _in_words(_adapter(kind).json_schema()) if is_plain(kind) else ""


def _in_words(schema: Mapping[str, Any]) -> str:
    """Return a JSON schema in words."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(filter(None, map(_in_words, schema["anyOf"]))))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    kind = str(schema.get("type", ""))
    if kind == "array":
        entries = _in_words(schema.get("items", {}))
        return f"list of {entries}" if entries else "list"
    words = {"integer": "whole number", "number": "number", "boolean": "true, false", "string": "text"}
    bounds = [f"{said} {_number(schema[key])}" for key, said in _BOUNDS.items() if key in schema]
    return ", ".join(filter(None, [words.get(kind, kind), *bounds]))


_BOUNDS = {
    "minimum": "at least",
    "exclusiveMinimum": "above",
    "maximum": "at most",
    "exclusiveMaximum": "below",
}


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
        InvalidInputError: The file is missing, too large, not UTF-8, or not valid YAML.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise InvalidInputError(
                f"{path} is larger than {MAX_YAML_BYTES >> 20} MiB; expected a short YAML file"
            )
        return parse_yaml_text(path.read_text(encoding="utf-8"), str(path))
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
    if (depth := _text_depth(text)) > _MAX_DEPTH:
        raise InvalidInputError(f"{source}: lists within lists, {depth} deep; at most {_MAX_DEPTH} are read")
    loader = _LOADER(text)
    try:
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


def suggest(name: object, valid: Iterable[object]) -> str:
    """Return ` Did you mean 'x'?` for the nearest valid name, or an empty text where none is near."""
    close = difflib.get_close_matches(str(name), [str(one) for one in valid], n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def _plain(value: Any, error: type[LiberoError], depth: int = 0) -> Any:
    """Return a value as JSON has it; texts stand for dates and others that JSON lacks."""
    if depth > _MAX_DEPTH:
        raise error(f"lists or keys within each other, more than {_MAX_DEPTH} deep")
    if isinstance(value, Mapping):
        return {_text_key(key, error): _plain(part, error, depth + 1) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part, error, depth + 1) for part in value]
    if isinstance(value, int) and abs(value) > _MAX_WHOLE:
        return math.inf
    if isinstance(value, str) and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
        raise error(f"the text {_shown(value)} has a character that is none (a lone surrogate)")
    if value is None or isinstance(value, bool | int | float | str):
        return value  # numbers that are not finite become NaN or Infinity, which every type refuses
    tolist = getattr(value, "tolist", None)  # of arrays and numbers of NumPy
    found = tolist() if callable(tolist) else str(value)
    return found if isinstance(found, str) else _plain(found, error, depth + 1)


def _text_key(key: object, error: type[LiberoError]) -> str:
    if not isinstance(key, str):
        raise error(f"the key {_shown(key)} is no text; write names as keys")
    return key


@dataclass(frozen=True)
class _Fault:
    path: tuple[Key, ...]
    text: str  # what is wrong, after the path


@lru_cache(maxsize=256)
def _adapter(kind: Any) -> "TypeAdapter[Any]":
    from pydantic import PydanticUserError, TypeAdapter

    _configure(kind)
    try:
        return TypeAdapter(kind, config=_config())
    except PydanticUserError:  # a class, which has its own
        return TypeAdapter(kind)


def _config(extra: Literal["allow", "forbid"] = "forbid") -> "ConfigDict":
    from pydantic import ConfigDict

    return ConfigDict(extra=extra, allow_inf_nan=False, arbitrary_types_allowed=True, protected_namespaces=())


def _configure(kind: Any) -> None:
    """Let pydantic refuse unknown keys and infinite numbers in dataclasses and typed dictionaries too."""
    if isinstance(kind, type) and "__annotations__" in vars(kind) and not hasattr(kind, "model_fields"):
        if "__pydantic_config__" in vars(kind):
            return
        kind.__pydantic_config__ = _config()  # type: ignore[attr-defined]
        for part in _children(kind).values():
            _configure(part)
    for part in get_args(kind):
        _configure(part)


@lru_cache(maxsize=256)
def _arguments_kind(target: Callable[..., Any]) -> Any:
    """Return a typed dictionary of the parameters of a function or class; None where they are not known."""
    from typing_extensions import TypedDict

    found = parameters_of(target)
    if found is None:
        return None
    hints = {n: t if is_plain(t) else Any for n, t in found.types.items() if not n.startswith("_")}
    kind: Any = TypedDict("Arguments", hints, total=False)  # type: ignore[misc]
    kind.__pydantic_config__ = _config("allow" if found.any_key else "forbid")
    return kind


def is_plain(kind: Any) -> bool:
    """Return whether values of a type are plain data: a function or a tensor is not."""
    try:
        hash(kind)
    except TypeError:  # of annotations with lists
        return False
    return _has_schema(kind)


@lru_cache(maxsize=256)
def _has_schema(kind: Any) -> bool:
    from pydantic import PydanticInvalidForJsonSchema, PydanticSchemaGenerationError, PydanticUserError
    from pydantic_core import SchemaError  # of a protocol

    no_schema = (PydanticInvalidForJsonSchema, PydanticSchemaGenerationError, PydanticUserError, SchemaError)
    try:
        _adapter(kind).json_schema()
    except (*no_schema, NameError, TypeError):  # names that exist for type checkers only
        return False
    return True


def _faults(errors: Sequence["ErrorDetails"], kind: Any, value: Any) -> list[_Fault]:
    """Return the faults of a validation, those of the branches of a union as one."""
    found: dict[tuple[Key, ...], list[ErrorDetails]] = {}
    for error in errors:
        found.setdefault(_real_path(error, value), []).append(error)
    return [_Fault(path, _describe(path, group, kind)) for path, group in found.items()]


def _real_path(error: "ErrorDetails", value: Any) -> tuple[Key, ...]:
    """Return the part of a location that consists of keys; pydantic adds the names of branches of unions."""
    path: list[Key] = []
    for key in error["loc"]:
        listed = isinstance(value, list | tuple) and isinstance(key, int) and key < len(value)
        if listed or (isinstance(value, Mapping) and key in value):
            value = value[key]
        elif isinstance(value, Mapping) and error["type"] == "missing" and key == error["loc"][-1]:
            value = None
        else:
            break
        path.append(key)
    return tuple(path)


def _describe(path: tuple[Key, ...], group: Sequence["ErrorDetails"], kind: Any) -> str:
    first = group[0]
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        valid = _field_names(kind, path[:-1])
        listed = f" Valid: {', '.join(valid) or 'none'}" if _node(kind, path[:-1]) is not None else ""
        return f"is an unknown key.{suggest(path[-1], valid)}{listed}"
    if first["type"] in ("missing", "missing_argument"):
        return "is missing"
    if first["type"] == "value_error":
        return f": {first['ctx']['error']}" if "ctx" in first else f": {first['msg']}"
    wanted = list(dict.fromkeys(_expected(error) for error in group))
    if _takes_none(kind, path):
        wanted.append("null")
    names = [
        n
        for e in group
        if e["type"] == "literal_error"
        for n in re.findall(r"'([^']*)'", e["ctx"]["expected"])
    ]
    near = suggest(first["input"], names) if isinstance(first["input"], str) else ""
    return f"is {_shown(first['input'])}; expected {' or '.join(wanted)}{near and f'.{near}'}"


_WORDS = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "a text",
    "none_required": "null",
    "list_type": "a list",
    "tuple_type": "a list",
    "sequence_type": "a list",
    "is_instance_of": "a list",
    "dict_type": "keys with values",
    "mapping_type": "keys with values",
    "dataclass_type": "keys with values",
    "dataclass_exact_type": "keys with values",
    "model_type": "keys with values",
    "callable_type": "a function or class",
}


def _expected(error: "ErrorDetails") -> str:
    kind, context = error["type"], error.get("ctx", {})
    match kind:
        case "greater_than":
            return f"above {_number(context['gt'])}"
        case "greater_than_equal":
            return f"at least {_number(context['ge'])}"
        case "less_than":
            return f"below {_number(context['lt'])}"
        case "less_than_equal":
            return f"at most {_number(context['le'])}"
        case "literal_error":
            return f"one of {context['expected']}"
        case "too_short":
            return f"at least {context['min_length']} entries"
        case "too_long":
            return f"at most {context['max_length']} entries"
        case "string_pattern_mismatch":
            return f"a text that matches {context['pattern']}"
        case "string_too_short":
            return "a text that is not empty"
    return _WORDS.get(kind) or error["msg"]


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _field_names(kind: Any, path: Sequence[Key]) -> list[str]:
    """Return the valid keys at a path of a type; empty where they are not known."""
    node = _node(kind, path)
    names = getattr(node, "model_fields", None) or getattr(node, "__dataclass_fields__", None)
    if names is None:
        names = getattr(node, "__annotations__", {}) if isinstance(node, type) else {}
    return [str(name) for name in names]


def _takes_none(kind: Any, path: Sequence[Key]) -> bool:
    return bool(path) and NoneType in get_args(_node(kind, path))


def _node(kind: Any, path: Sequence[Key]) -> Any:
    """Return the annotation at a path of a type; None where it is not known."""
    for key in path:
        kind = next((one for one in (kind, *get_args(kind)) if _children(one)), None)
        children = _children(kind)
        if key not in children:
            return None
        kind = children[key]
    options = [one for one in (kind, *get_args(kind)) if _children(one)]
    return options[0] if options and NoneType not in get_args(kind) else kind


def _children(kind: Any) -> dict[Any, Any]:
    if not isinstance(kind, type):
        return {}
    if (fields := getattr(kind, "model_fields", None)) is not None:
        return {name: info.annotation for name, info in fields.items()}
    if not hasattr(kind, "__annotations__"):
        return {}
    try:
        return get_type_hints(kind)
    except (NameError, TypeError):
        return {}


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 3]}..."


def _message(faults: Sequence[_Fault], source: str, prefix: tuple[Key, ...], line_of: LineOf | None) -> str:
    parts = []
    for fault in faults[:_MAX_FAULTS]:
        path = (*prefix, *fault.path)
        line = line_of(path) if line_of else None
        where = f"{source}:{line}: " if source and line else f"{source}: " if source else ""
        name = ".".join(map(str, path))
        text = fault.text if name or not fault.text.startswith(": ") else fault.text[2:]
        space = "" if text.startswith(":") or not name else " "
        parts.append(f"{where}{name}{space}{text}")
    more = len(faults) - _MAX_FAULTS
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


def _text_depth(text: str) -> int:
    """Return an upper bound of the nesting of a text, without parsing it: parsers in C have no limit of their own."""
    flow = depth = 0
    indents: list[int] = []
    for line in text.splitlines():
        stripped = line.lstrip(" ")
        if not stripped or stripped.startswith("#"):
            continue
        indent = len(line) - len(stripped)
        while indents and indents[-1] >= indent:
            indents.pop()
        indents.append(indent)
        marks = 0  # `- - - a` nests within a line
        for character in stripped:
            if character not in "-? ":
                break
            marks += character in "-?"
        for character in stripped:
            if character in "[{":
                flow += 1
            elif character in "]}":
                flow = max(0, flow - 1)
            depth = max(depth, flow + marks + len(indents))
    return depth


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
