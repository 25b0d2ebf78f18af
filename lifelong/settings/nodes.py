"""The gate of every configuration: keys, types, ranges and targets are checked here, before anything is built.

A node is what describes an object: keys with values, of which `_target_` is the dotted name of a class or function. The
others are its arguments, checked against the annotations in its signature. Nodes within nodes are built first; one with
`_partial_: true` is completed with further arguments by what it is given to.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from inspect import isclass
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from libero_env.errors import InvalidInputError
from libero_env.text import suggest
from libero_env.validation import is_plain, parameters_of, validate_arguments
from lifelong.errors import ConfigError
from lifelong.settings.targets import find_target
from lifelong.types import CompletedWith

Path = tuple[str | int, ...]

# Keys of a node that are none of its target's arguments: as in Hydra, of which `_convert_` changes nothing here.
_SPECIAL = ("_target_", "_partial_", "_args_", "_convert_", "_recursive_")


def build(node: Mapping[str, Any] | DictConfig, /, **arguments: Any) -> Any:
    """Build the object that a node of a configuration describes, which the caller has composed himself.

    Args:
        node: Node with `_target_`, the dotted path of a class or function.
        arguments: Further keyword arguments of the target.

    Raises:
        ConfigError: A key is unknown or missing, or a value is of another kind or outside of its range.
    """
    at: Path = ()
    if isinstance(node, DictConfig):
        at = tuple(node._get_full_key(None).split(".")) if node._get_full_key(None) else ()
        node = plain_data(node)
    raise_faults(node_faults(node, at, given=tuple(arguments)))
    return build_checked(node, **arguments)


def plain_data(config: DictConfig) -> dict[str, Any]:
    """Return a composed configuration as plain data, with its interpolations resolved.

    Raises:
        ConfigError: An interpolation refers to nothing or to itself, or a mandatory value (`???`) is missing.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        reason, *_ = str(error).splitlines()
        raise ConfigError(f"{error.full_key}: {reason}" if error.full_key else reason) from error
    return plain


def raise_faults(faults: Iterator[str] | Sequence[str], source: str = "") -> None:
    """Raise one error that names all faults; none where there are none.

    Raises:
        ConfigError: There are faults.
    """
    found = list(faults)
    if found:
        more = f"; and {len(found) - 8} more" if len(found) > 8 else ""
        raise ConfigError(f"{source}{': ' if source else ''}{'; '.join(found[:8])}{more}")


def node_faults(
    node: Any,
    at: Path,
    *,
    given: Sequence[str] = (),
    completed: Sequence[str] = (),
    kind: type | None = None,
    strict: bool = False,
    allowed: Sequence[str] | None = None,
) -> Iterator[str]:
    """Yield what is wrong with a node and the nodes within it, each with its full key.

    Args:
        node: Plain data.
        at: Path of the node in the configuration.
        given: Names of the arguments that whoever builds the node adds.
        completed: Names of the arguments that whoever gets what is built calls it with: `_partial_` must be true.
        kind: Class of what it builds; None for any.
        strict: Whether a user's own class must be of that class too, or may only resemble it.
        allowed: See `find_target`.
    """
    name = ".".join(map(str, at)) or "the configuration"
    if not isinstance(node, Mapping):
        yield f"{name} is {_shown(node)}; expected keys with values, _target_ among them"
        return
    if "_target_" not in node:
        choose = f"; choose a file of that group with {'/'.join(map(str, at))}=NAME" if at else ""
        yield f"{name}._target_ is missing, the name of a class{choose}"
        return
    try:
        target = find_target(node["_target_"], allowed)
    except ConfigError as error:
        yield f"{name}._target_ {error}"
        return
    if kind and isclass(target) and (strict or _is_own(target)) and not issubclass(target, kind):
        yield f"{name}._target_ is {node['_target_']}; expected a {kind.__name__}"
        return
    if not isinstance(node.get("_partial_", False), bool):
        yield f"{name}._partial_ is {_shown(node['_partial_'])}; expected true or false"
        return
    if not isinstance(node.get("_args_", []), list | tuple):
        yield f"{name}._args_ is {_shown(node['_args_'])}; expected a list"
        return
    known, positional = parameters_of(target), node.get("_args_", ())
    names = [key for key in known.types if key not in node][: len(positional)] if known else []
    for index, value in enumerate(positional[len(names) :]):
        yield from _value_faults(value, Any, (*at, "_args_", index), allowed)
    arguments = dict(zip(names, positional, strict=False))
    arguments |= {str(key): value for key, value in node.items() if key not in _SPECIAL}
    yield from _argument_faults(target, arguments, at, allowed)
    if completed and _is_own(target) and not node.get("_partial_"):
        yield f"{name}._partial_ is {node.get('_partial_', 'missing')}; expected true"
        return
    if completed and known and not known.any_key and (lacking := set(completed) - set(known.types)):
        yield (
            f"{name}._target_ is {node['_target_']}, which does not take {', '.join(sorted(lacking))}: "
            f"{name} is called with {', '.join(completed)}"
        )
        return
    if known and (completed or not node.get("_partial_")):
        given = (*given, *completed)
        for missing in sorted(known.required - {*arguments, *given}):
            yield f"{'.'.join(map(str, (*at, missing)))} is missing"


def build_checked(node: Mapping[str, Any], allowed: Sequence[str] | None = None, /, **arguments: Any) -> Any:
    """Build the object that a checked node describes.

    Args:
        node: Node in which `node_faults` has found none.
        allowed: See `find_target`.
        arguments: Further keyword arguments of the target.
    """
    target = find_target(node["_target_"], allowed)
    within = node if node.get("_recursive_") is False else {k: _built(v, allowed) for k, v in node.items()}
    own = {str(key): value for key, value in within.items() if key not in _SPECIAL}
    call = partial(target, *within.get("_args_", ()), **own)
    return partial(call, **arguments) if node.get("_partial_") else call(**arguments)


def _built(value: Any, allowed: Sequence[str] | None) -> Any:
    """Return an argument with its nodes built."""
    if isinstance(value, Mapping):
        if "_target_" in value:
            return build_checked(value, allowed)
        return {key: _built(part, allowed) for key, part in value.items()}
    return [_built(part, allowed) for part in value] if isinstance(value, list | tuple) else value


def as_truth(value: Any, hint: Any) -> Any:
    """Return 0 and 1 as truths where a truth is expected and no number."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return bool(value) if bool in options and value in (0, 1) and not {int, float} & set(options) else value


def _argument_faults(
    target: Any, arguments: Mapping[str, Any], at: Path, allowed: Sequence[str] | None
) -> Iterator[str]:
    """Yield what is wrong with the arguments of a target: names, values, and nodes."""
    known = parameters_of(target)
    types = known.types if known else {}
    own = _is_own(target)  # a user's class may take what resembles its types
    plain = {key for key, hint in types.items() if own and hint is not Any and is_plain(hint)}
    values = {key: value for key, value in arguments.items() if key in plain or not _has_node(value)}
    try:
        validate_arguments(target, {k: as_truth(v, types.get(k)) for k, v in values.items()}, prefix=at)
    except InvalidInputError as error:
        yield str(error)
    for key, value in arguments.items():
        if known and key not in types and not known.any_key:
            if key not in values:
                full = ".".join(map(str, (*at, key)))
                yield f"{full} is an unknown key.{suggest(key, types)} Valid: {', '.join(types)}"
        elif key not in plain:
            yield from _value_faults(value, types.get(key, Any) if own else Any, (*at, key), allowed)


def _value_faults(value: Any, hint: Any, at: Path, allowed: Sequence[str] | None) -> Iterator[str]:
    """Yield what is wrong with a value that is a node or has nodes, or is no node where one belongs."""
    completed: Sequence[str] = ()
    if get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        completed = next((note.names for note in notes if isinstance(note, CompletedWith)), ())
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if isinstance(value, Mapping) and "_target_" in value:
        classes = [one for one in options if isclass(one) and one not in (NoneType, object)]
        kind = classes[0] if len(classes) == 1 and len(options) - (NoneType in options) == 1 else None
        yield from node_faults(value, at, completed=completed, kind=kind, allowed=allowed)
        if kind and value.get("_partial_") is True:
            yield f"{'.'.join(map(str, at))}._partial_ is True; expected a whole {kind.__name__}"
    elif isinstance(value, list | tuple):
        (entry, *_) = [*(get_args(one)[0] for one in options if get_args(one)), Any]
        for index, part in enumerate(value):
            yield from _value_faults(part, entry, (*at, index), allowed)
    elif isinstance(value, Mapping) and _has_node(value):
        for key, part in value.items():
            yield from _value_faults(part, Any, (*at, str(key)), allowed)
    elif not any(one is Any or _is_open(one) or is_plain(one) for one in options) and (
        value is not None or NoneType not in options
    ):
        yield _no_component(value, at)


def _no_component(value: Any, at: Path) -> str:
    name = ".".join(map(str, at))
    choose = (
        f"; a file of that group is chosen with {'/'.join(map(str, at))}={value}"
        if isinstance(value, str)
        else ""
    )
    return f"{name} is {_shown(value)}; expected a component: keys with values, _target_ among them{choose}"


def _is_open(hint: Any) -> bool:
    """Return whether an annotation says nothing about values: a type variable, a name that was not resolved."""
    return not isclass(hint) and get_origin(hint) is None


def _is_own(target: Any) -> bool:
    return (getattr(target, "__module__", None) or "").startswith("lifelong.")


def _has_node(value: Any) -> bool:
    if isinstance(value, Mapping):
        return "_target_" in value or any(map(_has_node, value.values()))
    return isinstance(value, list | tuple) and any(map(_has_node, value))


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
