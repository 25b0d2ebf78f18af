"""Values against annotated types.

Types are those of pydantic (`Annotated[float, Field(gt=0)]`, `Literal`, dataclasses, `TypedDict`), read strictly: a
text is no number, a truth is no whole number, numbers are finite.
"""

import inspect
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.text import shown
from libero_env.validation.messages import Key, LineOf, children, find_faults, in_words, message

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter

_MAX_DEPTH = 60
_MAX_WHOLE = 10**300  # whole numbers beyond it count as infinite


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
        faults = find_faults(found.errors(include_url=False), kind, value)
        raise error(message(faults, source, tuple(prefix), line_of)) from None


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
    return in_words(_adapter(kind).json_schema()) if is_plain(kind) else ""


def is_plain(kind: Any) -> bool:
    """Return whether values of a type are plain data: a function or a tensor is not."""
    try:
        hash(kind)
    except TypeError:  # of annotations with lists
        return False
    return _has_schema(kind)


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
        raise error(f"the text {shown(value)} has a character that is none (a lone surrogate)")
    if value is None or isinstance(value, bool | int | float | str):
        return value  # numbers that are not finite become NaN or Infinity, which every type refuses
    tolist = getattr(value, "tolist", None)  # of arrays and numbers of NumPy
    found = tolist() if callable(tolist) else str(value)
    return found if isinstance(found, str) else _plain(found, error, depth + 1)


def _text_key(key: object, error: type[LiberoError]) -> str:
    if not isinstance(key, str):
        raise error(f"the key {shown(key)} is no text; write names as keys")
    return key


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
        for part in children(kind).values():
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
    make: Any = TypedDict  # its fields are known at run time only
    kind = make("Arguments", hints, total=False)
    kind.__pydantic_config__ = _config("allow" if found.any_key else "forbid")
    return kind


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
