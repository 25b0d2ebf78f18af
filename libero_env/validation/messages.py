"""Faults of values in words: where each is, what the value is, and what is valid."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from libero_env.text import shown, suggest

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Key = str | int
LineOf = Callable[[Sequence[Key]], int | None]

_MAX_FAULTS = 4  # in a message


@dataclass(frozen=True)
class Fault:
    """What is wrong with a value.

    Attributes:
        path: Keys that lead to it.
        text: What is wrong, after the path.
    """

    path: tuple[Key, ...]
    text: str


def message(faults: Sequence[Fault], source: str, prefix: tuple[Key, ...], line_of: LineOf | None) -> str:
    """Return faults in one line, see `libero_env.validation.validate`."""
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


def find_faults(errors: Sequence["ErrorDetails"], kind: Any, value: Any) -> list[Fault]:
    """Return the faults of a validation, those of the branches of a union as one."""
    found: dict[tuple[Key, ...], list[ErrorDetails]] = {}
    for error in errors:
        found.setdefault(_real_path(error, value), []).append(error)
    exact: dict[tuple[Key, ...], list[ErrorDetails]] = {}
    for path, group in found.items():
        one_branch = len({error["loc"][: len(path) + 1] for error in group}) == 1
        for error in group:
            exact.setdefault(_real_path(error, value, skip=True) if one_branch else path, []).append(error)
    return [Fault(path, _describe(path, group, kind)) for path, group in exact.items()]


def in_words(schema: Mapping[str, Any]) -> str:
    """Return a JSON schema in words."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(filter(None, map(in_words, schema["anyOf"]))))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    kind = str(schema.get("type", ""))
    if kind == "array":
        entries = in_words(schema.get("items", {}))
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


def children(kind: Any) -> dict[Any, Any]:
    """Return the annotations of a class by name; empty where it has none."""
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


def _real_path(error: "ErrorDetails", value: Any, skip: bool = False) -> tuple[Key, ...]:
    """Return the part of a location that consists of keys; pydantic adds the names of branches of unions.

    Args:
        error: Error of pydantic.
        value: Value that was validated.
        skip: Whether to go on behind the name of a branch, which is right where there is only one.
    """
    path: list[Key] = []
    for key in error["loc"]:
        listed = isinstance(value, list | tuple) and isinstance(key, int) and key < len(value)
        if listed or (isinstance(value, Mapping) and key in value):
            value = value[key]
        elif isinstance(value, Mapping) and error["type"] == "missing" and key == error["loc"][-1]:
            value = None
        elif skip:
            continue
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
    return f"is {shown(first['input'])}; expected {' or '.join(wanted)}{near and f'.{near}'}"


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
            return f"at least {_entries(context['min_length'])}"
        case "too_long":
            return f"at most {_entries(context['max_length'])}"
        case "string_pattern_mismatch":
            return f"a text that matches {context['pattern']}"
        case "string_too_short":
            return "a text that is not empty"
    return _WORDS.get(kind) or error["msg"]


def _entries(count: int) -> str:
    return f"{count} {'entry' if count == 1 else 'entries'}"


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
        kind = next((one for one in (kind, *get_args(kind)) if children(one)), None)
        parts = children(kind)
        if key not in parts:
            return None
        kind = parts[key]
    options = [one for one in (kind, *get_args(kind)) if children(one)]
    return options[0] if options and NoneType not in get_args(kind) else kind
