"""Values against annotated types: strictly, with errors in one line that say where, which value, and what is valid.

Types are those of pydantic (`Annotated[float, Field(gt=0)]`, `Literal`, dataclasses, `TypedDict`): a text is not a
number, a bool is not a whole number, numbers are finite, unknown keys are errors.
"""

import contextlib
import dataclasses
import functools
import inspect
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform, get_args, get_type_hints

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.text import shown, suggest

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails

Key = str | int
LineOf = Callable[[Sequence[Key]], int | None]
Class = TypeVar("Class", bound=type)

_MAX_DEPTH = 60
_MAX_WHOLE = 10**300  # whole numbers beyond it count as infinite
_MAX_ERRORS = 4  # in a message
_CONFIG = {
    "extra": "forbid",
    "allow_inf_nan": False,
    "arbitrary_types_allowed": True,
    "protected_namespaces": (),
}


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
        value: Plain data: mappings, lists, numbers, texts, bools and None.
        source: Name of the file that the value comes from; empty for none.
        prefix: Path of the value in its source, which is shown before the paths in it.
        line_of: Function that returns the line of a path (with the prefix) in the source, from 1.

    Raises:
        InvalidInputError: A key is unknown or missing, or a value is of another kind or outside of its range; or
            `error`.
    """
    from pydantic import ValidationError

    try:
        # as JSON, where strict means: no conversions between kinds, but keys with values make a dataclass
        return _adapter(kind).validate_json(json.dumps([_json(value, error)]), strict=True)[0]
    except ValidationError as failure:
        # the adapter is that of a list with one entry, so that its configuration holds for any type
        errors = [{**one, "loc": one["loc"][1:]} for one in failure.errors(include_url=False)]
        parts = []
        for path, text in _describe_all(errors, kind, value):
            full = (*prefix, *path)
            line = line_of(full) if line_of else None
            where = f"{source}:{line}: " if source and line else f"{source}: " if source and line_of else ""
            parts.append(where + _joined(full, text))
        once = f"{source}: " if source and not line_of else ""
        raise error(once + _limited(parts)) from None


def validate_arguments(
    target: Callable[..., Any],
    arguments: Mapping[str, Any],
    *,
    prefix: Sequence[Key] = (),
    error: type[LiberoError] = InvalidInputError,
) -> None:
    """Check keyword arguments against the annotations in the signature of a function or class.

    Parameters without an annotation, and those whose types are not plain data, take anything. Arguments that are
    missing are not an error: the caller may add them.

    Args:
        target: Function or class.
        arguments: Plain data by the name of the parameter.
        prefix: Path of the arguments, which is shown before their names.

    Raises:
        InvalidInputError: An argument is unknown, or of another kind or outside of its range; or `error`.
    """
    kind = _arguments_kind(target)
    if kind is not None:
        validate(kind, dict(arguments), prefix=prefix, error=error)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def checked(cls: Class) -> Class:
    """Make a class a frozen dataclass whose constructor checks its arguments against the annotations.

    The constructor raises an InvalidInputError that begins with the name of the class. `__post_init__` may check what
    depends on several fields; an error of this package that it raises passes unchanged.
    """
    from pydantic import ValidationError
    from pydantic.dataclasses import dataclass

    made: Any = dataclass(frozen=True, config={**_CONFIG, "strict": True})(cls)  # type: ignore[call-overload]
    construct = made.__init__

    @functools.wraps(construct)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            construct(self, *args, **kwargs)
        except ValidationError as failure:
            names = [field.name for field in dataclasses.fields(cls)]
            errors: list[Any] = []
            for one in failure.errors(include_url=False):
                if isinstance(original := one.get("ctx", {}).get("error"), LiberoError):
                    raise original from None
                first, *rest = one["loc"]
                loc = (names[first] if isinstance(first, int) else first, *rest)
                errors.append({**one, "loc": loc})
            values = {**dict(zip(names, args, strict=False)), **kwargs}
            described = _describe_all(errors, cls, values)
            message = _limited([_joined(path, text) for path, text in described])
            invalid = InvalidInputError(f"{cls.__name__}: {message}")
            invalid.path = described[0][0]
            raise invalid from None

    made.__init__ = __init__
    return made


@dataclasses.dataclass(frozen=True)
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


@functools.lru_cache(maxsize=256)
def parameters_of(target: Callable[..., Any]) -> Parameters | None:
    """Return the parameters of a function or class; None where they are not known, as of some builtins."""
    try:
        parameters = inspect.signature(target).parameters.values()
    except (TypeError, ValueError):
        return None
    try:
        hints = get_type_hints(target.__init__ if inspect.isclass(target) else target, include_extras=True)
    except (NameError, TypeError, AttributeError):  # names that exist for type checkers only
        hints = {}
    named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    return Parameters(
        types={p.name: hints.get(p.name, Any) for p in named},
        required=frozenset(p.name for p in named if p.default is p.empty),
        any_key=any(p.kind is p.VAR_KEYWORD for p in parameters),
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


def is_plain(kind: Any) -> bool:
    """Return whether values of a type are plain data: a function or a tensor is not."""
    from pydantic import PydanticInvalidForJsonSchema, PydanticSchemaGenerationError, PydanticUserError
    from pydantic_core import SchemaError  # of a protocol

    no_schema = (PydanticInvalidForJsonSchema, PydanticSchemaGenerationError, PydanticUserError, SchemaError)
    try:
        _adapter(kind).json_schema()
    except (*no_schema, NameError, TypeError):  # names of type checkers only; annotations with lists
        return False
    return True


def _json(value: Any, error: type[LiberoError], depth: int = 0) -> Any:
    """Return a value as JSON has it; texts stand for dates and others that JSON lacks."""
    if depth > _MAX_DEPTH:
        raise error(f"lists or keys within each other, more than {_MAX_DEPTH} deep")
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise error(f"the key {shown(key)} is not a text; write names as keys")
        return {_json(key, error): _json(part, error, depth + 1) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_json(part, error, depth + 1) for part in value]
    if isinstance(value, int) and abs(value) > _MAX_WHOLE:
        return math.inf
    if isinstance(value, str) and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
        raise error(f"the text {shown(value)} has a character that is none (a lone surrogate)")
    if value is None or isinstance(value, bool | int | float | str):
        return value  # numbers that are not finite become NaN or Infinity, which every type refuses
    if isinstance(value, PurePath):  # whose name may be any bytes
        return str(value).encode(errors="replace").decode()
    tolist = getattr(value, "tolist", None)  # of arrays and numbers of NumPy
    converted = tolist() if callable(tolist) else str(value)
    return converted if isinstance(converted, str) else _json(converted, error, depth + 1)


@functools.lru_cache(maxsize=512)
def _adapter(kind: Any) -> "TypeAdapter[Any]":
    """Return the validator of a list with one entry of a type, whose dataclasses and dictionaries take its settings."""
    from pydantic import TypeAdapter

    return TypeAdapter(tuple[kind], config=_CONFIG)  # type: ignore[arg-type]


@functools.lru_cache(maxsize=256)
def _arguments_kind(target: Callable[..., Any]) -> Any:
    """Return a typed dictionary of the parameters of a function or class; None where they are not known."""
    from typing_extensions import TypedDict

    parameters = parameters_of(target)
    if parameters is None:
        return None
    hints = {n: t if is_plain(t) else Any for n, t in parameters.types.items() if not n.startswith("_")}
    make: Any = TypedDict  # its fields are known at run time only
    kind = make("Arguments", hints, total=False)
    if parameters.any_key:
        kind.__pydantic_config__ = {**_CONFIG, "extra": "allow"}
    return kind


def _joined(path: tuple[Key, ...], text: str) -> str:
    """Return what is wrong after the path of the value; a text that begins with a colon needs no verb."""
    name = ".".join(map(str, path))
    if not name:
        return text.removeprefix(": ")
    return f"{name}{'' if text.startswith(':') else ' '}{text}"


def _limited(parts: Sequence[str]) -> str:
    more = len(parts) - _MAX_ERRORS
    return "; ".join(parts[:_MAX_ERRORS]) + (f"; and {more} more" if more > 0 else "")


def _describe_all(errors: Sequence[Any], kind: Any, value: Any) -> list[tuple[tuple[Key, ...], str]]:
    """Return path and text of each value that is not valid; what the branches of a union say of one value is one."""
    by_path: dict[tuple[Key, ...], list[ErrorDetails]] = {}
    for error in errors:
        by_path.setdefault(_real_path(error, value), []).append(error)
    return [(path, _describe(path, group, kind)) for path, group in by_path.items()]


def _real_path(error: "ErrorDetails", value: Any) -> tuple[Key, ...]:
    """Return the part of a location that consists of keys; pydantic adds the names of branches of unions."""
    path: list[Key] = []
    for key in error["loc"]:
        listed = isinstance(value, list | tuple) and isinstance(key, int) and key < len(value)
        if listed or (isinstance(value, Mapping) and key in value):
            value = value[key]
        elif not (error["type"].startswith("missing") and key == error["loc"][-1]):
            continue
        path.append(key)
    return tuple(path)


def _describe(path: tuple[Key, ...], group: Sequence["ErrorDetails"], kind: Any) -> str:
    first = group[0]
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        fields = _annotations(_type_at(kind, path[:-1]))
        listed = f" Valid: {', '.join(fields)}" if fields else ""
        return f"is an unknown key.{suggest(path[-1], fields)}{listed}"
    if first["type"].startswith("missing"):
        return "is missing"
    if first["type"] == "value_error":
        return f": {first['ctx']['error']}" if "ctx" in first else f": {first['msg']}"
    said = [one["msg"].replace("Input should be", "expected", 1) for one in group]
    wanted = " or ".join(dict.fromkeys(text[0].lower() + text[1:] for text in said)).replace(
        " or expected", " or"
    )
    names = [
        name
        for one in group
        if one["type"] == "literal_error"
        for name in re.findall(r"'([^']*)'", one["ctx"]["expected"])
    ]
    near = suggest(first["input"], names) if isinstance(first["input"], str) else ""
    return f"is {shown(first['input'])}; {wanted}{near and f'.{near}'}"


def _annotations(kind: Any) -> Mapping[str, Any]:
    """Return the annotations of a class, or of the first of a union that has some; empty where none has."""
    for one in (kind, *get_args(kind)):
        if not isinstance(one, type):
            continue
        if (fields := getattr(one, "model_fields", None)) is not None:
            return {name: info.annotation for name, info in fields.items()}
        with contextlib.suppress(NameError, TypeError):
            if hints := get_type_hints(one):
                return hints
    return {}


def _type_at(kind: Any, path: Sequence[Key]) -> Any:
    """Return the annotation at a path of a type; None where it is not known."""
    for key in path:
        fields = _annotations(kind)
        if fields and isinstance(key, str):
            kind = fields.get(key)
        else:  # of a list or mapping: the type of its values
            kind = next(
                (one for one in reversed(get_args(kind)) if isinstance(one, type) or get_args(one)), None
            )
    return kind
