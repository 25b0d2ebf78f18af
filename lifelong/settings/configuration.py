"""From a configuration to objects: targets, keys and values are checked at the one place where they are built.

A node describes an object: keys with values, of which `_target_` is the dotted name of a class or function. The others
are its arguments, checked against the annotations in its signature. Nodes within nodes are built first; one with
`_partial_: true` is completed with further arguments by the object that it is given to.

Whoever composes a configuration, on the command line or in files of his own, may name any class or function. A saved
configuration may be somebody else's: there, a name must be one of this package's classes that are made to be built, or
lie in a package that the user has allowed.
"""

import os
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from inspect import isclass
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from libero_env.text import shown, suggest
from libero_env.validation import is_plain, parameters_of, validate, validate_arguments
from lifelong.errors import ConfigError, require_same_module
from lifelong.settings.run import RunSettings
from lifelong.types import CompletedWith

Target = Callable[..., Any]
Path = tuple[str | int, ...]

# What each group of the configuration builds.
GROUPS = {
    "algo": "lifelong.algorithms.base.Algorithm",
    "benchmark": "lifelong.settings.run.BenchmarkSettings",
    "stream": "lifelong.streams.StreamSettings",
    "pretrain": "lifelong.settings.run.PretrainSettings",
    "policy": "lifelong.policies.base.Policy",
    "data": "lifelong.data.settings.DataSettings",
    "augmentation": "lifelong.nn.augmentation.Augmentation",
    "train": "lifelong.training.settings.FitSettings",
    "eval": "lifelong.evaluation.settings.EvalSettings",
    "language": "lifelong.language.encoder.LanguageEncoder",
    "tracker": "lifelong.tracking.Tracker",
    "learner": "lifelong.context.Learner",
}
_OPTIONAL = ("learner",)  # groups that a configuration may lack
# Components of algorithms and policies.
_COMPONENTS = (
    "lifelong.data.memory.ReplayMemory",
    "lifelong.algorithms.importance.ImportanceEstimator",
    "torch.nn.Module",
)
_OURS = ("lifelong", "libero_integrations")  # packages whose classes may always be named
# where a user's own class must be derived from ours; elsewhere it may resemble it
_STRICT = ("algo", "policy")
_SPECIAL = ("_target_", "_partial_")  # keys of a node that are not arguments


@dataclass(frozen=True)
class Configuration:
    """The configuration of a run as plain data.

    Attributes:
        values: Keys at the top, and the nodes of the groups.
        source: File that it was read from, for error messages; empty where it was composed.
        allowed: Packages besides this one that may be named in it; see `find_target`. None: the user has composed it,
            and may name anything.
    """

    values: Mapping[str, Any]
    source: str = ""
    allowed: Sequence[str] | None = None

    def settings(self) -> RunSettings:
        """Return the keys at the top.

        Raises:
            ConfigError: A key at the top is unknown, missing or not valid, or a group is missing.
        """
        valid = [*RunSettings.__dataclass_fields__, *GROUPS]
        for key in self.values:
            if key not in valid:
                raise ConfigError(f"{key} is an unknown key.{suggest(key, valid)} Valid: {', '.join(valid)}")
        for group in GROUPS:
            if group in self.values or group not in _OPTIONAL:
                self._node(group)
        top = {key: value for key, value in self.values.items() if key not in GROUPS}
        return validate(RunSettings, top, error=ConfigError)

    def build(self, group: str, **arguments: Any) -> Any:
        """Build what a group describes.

        Args:
            arguments: Further keyword arguments of its target.

        Raises:
            ConfigError: A key is unknown or missing, a value is of another kind or outside of its range, or the group
                builds something else than it is for.
        """
        try:
            node, kind = self._node(group), pkgutil.resolve_name(GROUPS[group])
            found = _other_class(node, (kind,), self.allowed)
            if found is None or not (group in _STRICT or _is_own(found)):
                built = _build(node, (group,), self.allowed, arguments)
                found = None if isinstance(built, kind) else type(built)
            if found is not None and (group in _STRICT or found is partial or _is_own(found)):
                raise ConfigError(f"{group} builds a {found.__name__}; expected a {kind.__name__}")
        except ConfigError as error:
            raise (ConfigError(f"{self.source}: {error}") if self.source else error) from error.__cause__
        return built

    def is_own(self, group: str) -> bool:
        """Return whether a group and all of its components are classes of this package."""
        return all(_is_within(name, _OURS) for name in _targets(self._node(group)))

    def _node(self, group: str) -> Any:
        if group not in self.values:
            raise ConfigError(f"{group} is missing; choose a file of that group with {group}=NAME")
        return self.values[group]


def build(node: Mapping[str, Any] | DictConfig, /, **arguments: Any) -> Any:
    """Build the object that a node of a configuration describes, which the caller has composed himself.

    Args:
        node: Node with `_target_`, the dotted path of a class or function.
        arguments: Further keyword arguments of the target.

    Raises:
        ConfigError: A key is unknown or missing, or a value is of another kind or outside of its range.
    """
    return _build(plain_data(node) if isinstance(node, DictConfig) else node, (), None, arguments)


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


def _build(
    node: Any, at: Path, allowed: Sequence[str] | None, more: Mapping[str, Any], completed: Sequence[str] = ()
) -> Any:
    """Build the object of a node.

    Args:
        node: Plain data.
        at: Path of the node in the configuration.
        allowed: See `find_target`.
        more: Further arguments.
        completed: Names of the arguments with which the object that gets it calls it: `_partial_` must be true.
    """
    name = ".".join(map(str, at)) or "the configuration"
    if not isinstance(node, Mapping) or "_target_" not in node:
        choice = node if isinstance(node, str) else "NAME"
        raise ConfigError(
            f"{name} is {shown(node)}; expected a component: keys with values, _target_ among them; a file of that "
            f"group is chosen with {'/'.join(map(str, at))}={choice}"
        )
    try:
        target = find_target(node["_target_"], allowed)
    except ConfigError as error:
        raise ConfigError(f"{name}._target_ {error}") from None
    values = {str(key): value for key, value in node.items() if key not in _SPECIAL}
    if allowed is not None and (loads := getattr(target, "loads_from_elsewhere", None)):
        package, what = loads(values)
        if what and package not in allowed:
            raise ConfigError(
                f"{name}.{what} has {package} load what it names, on this machine or from a network; if you know and "
                f"trust it, allow it with --allow {package}"
            )
    is_partial = node.get("_partial_", False)
    if is_partial not in (True, False) or (completed and _is_own(target) and not is_partial):
        raise ConfigError(
            f"{name}._partial_ is {shown(is_partial)}; expected {'true' if completed else 'true or false'}"
        )
    # a class that checks what it is built with
    if hasattr(target, "__pydantic_validator__") and not is_partial:
        try:
            return validate(target, {**values, **more}, prefix=at, error=ConfigError)
        except ConfigError as error:
            raise ConfigError(str(error).removeprefix(f"{name}: ")) from None  # which names keys in full
    parameters, own = parameters_of(target), _is_own(target)
    hints = parameters.types if parameters else {}
    nested = {key for key, value in values.items() if _is_nested(value, hints.get(key, Any), own)}
    checked = {key: value for key, value in values.items() if key not in nested or key not in hints}
    validate_arguments(target, checked, prefix=at, error=ConfigError)
    if parameters:
        if lacking := set() if parameters.any_key else set(completed) - set(hints):
            raise ConfigError(
                f"{name}._target_ is {node['_target_']}, which does not take {', '.join(sorted(lacking))}: "
                f"{name} is called with {', '.join(completed)}"
            )
        missing = parameters.required - {*values, *more, *completed}
        if missing and (completed or not is_partial):
            raise ConfigError(f"{name}.{min(missing)} is missing")
    for key in nested:
        values[key] = _component(values[key], hints.get(key, Any) if own else Any, (*at, key), allowed)
    call = partial(target, **values, **more)
    return call if is_partial else call()


def _component(value: Any, hint: Any, at: Path, allowed: Sequence[str] | None) -> Any:
    """Return a value with its nodes built, and check that they are what the annotation says."""
    completed: Sequence[str] = ()
    if get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        completed = next((note.names for note in notes if isinstance(note, CompletedWith)), ())
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if isinstance(value, Mapping) and "_target_" in value:
        kinds = tuple(one for one in options if isclass(one) and one not in (Any, NoneType))
        if not kinds or len(kinds) + (NoneType in options) != len(options):
            kinds = (object,)
        found = _other_class(value, kinds, allowed)
        built = _build(value, at, allowed, {}, completed) if found is None else None
        if found is not None or not isinstance(built, kinds):
            name, expected = (found or type(built)).__name__, " or ".join(kind.__name__ for kind in kinds)
            raise ConfigError(f"{'.'.join(map(str, at))} builds a {name}; expected a {expected}")
        return built
    holds = any(one is Any or _is_instance(value, get_origin(one) or one) for one in options)
    if isinstance(value, list | tuple) and holds:
        (entry, *_) = [*(get_args(one)[0] for one in options if get_args(one)), Any]
        return [_component(part, entry, (*at, index), allowed) for index, part in enumerate(value)]
    if isinstance(value, Mapping) and _has_node(value) and holds:
        return {key: _component(part, Any, (*at, str(key)), allowed) for key, part in value.items()}
    if (value is None and NoneType in options) or any(one is Any or is_plain(one) for one in options):
        return value
    return _build(value, at, allowed, {})  # which says what a component is


def _is_instance(value: Any, kind: Any) -> bool:
    return isclass(kind) and isinstance(value, kind)


def _other_class(node: Mapping[str, Any], kinds: tuple[type, ...], allowed: Sequence[str] | None) -> Any:
    """Return the class that a node builds where it is not one of those expected: building it may take any memory."""
    try:
        target = find_target(node["_target_"], allowed)
        if isclass(target) and not node.get("_partial_", False) and not issubclass(target, kinds):
            return target
    except (ConfigError, KeyError, TypeError):  # which `_build` says, or a protocol with attributes
        pass
    return None


def _is_nested(value: Any, hint: Any, own: bool) -> bool:
    """Return whether an argument is, or has to be, a component; a user's class may take what resembles its types."""
    if hint is Any or not own:
        return _has_node(value)
    return not is_plain(hint)


def _is_own(target: Any) -> bool:
    return _is_within(getattr(target, "__module__", None) or "", _OURS)


def _has_node(value: Any) -> bool:
    return bool(_targets(value))


def _targets(value: Any) -> list[str]:
    """Return all `_target_`s within a value."""
    if isinstance(value, Mapping):
        own = [str(value["_target_"])] if "_target_" in value else []
        return own + [name for part in value.values() for name in _targets(part)]
    return [name for part in value for name in _targets(part)] if isinstance(value, list | tuple) else []


def find_target(name: object, allowed: Sequence[str] | None = None) -> Target:
    """Return the class or function of a dotted name.

    Args:
        name: Value of `_target_`.
        allowed: Packages whose classes and functions a saved configuration may name beside this package's classes.
            None: the user has composed the configuration, and any name is valid.

    Raises:
        ConfigError: There is no such class or function, or it is not allowed.
    """
    parts = name.split(".") if isinstance(name, str) and len(name) <= 200 else []
    if len(parts) < 2 or not all(part.isidentifier() for part in parts):
        raise ConfigError(f"is {shown(name)}; expected the name of a class, such as {GROUPS['algo']}")
    if allowed is None:
        return _resolve(str(name))
    if parts[0] in _OURS:
        if (own := _own_class(parts)) is not None:
            return own
    elif _is_within(str(name), allowed):
        target = _resolve(str(name))
        if _is_within(getattr(target, "__module__", None) or "", (*allowed, *_OURS)):
            return target
    advice = (
        f"; if you know and trust its code, allow it with --allow {parts[0]}" if parts[0] not in _OURS else ""
    )
    raise ConfigError(
        f"names {name}, which is not a class that this package builds from a saved configuration{advice}"
    )


def _is_within(name: str, packages: Sequence[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def _resolve(name: str) -> Target:
    """Return the class or function of a name; modules are looked for in the current folder, too, after all others."""
    try:
        package = name.partition(".")[0]
        if package in sys.modules:  # perhaps without a specification, as the module of a notebook is
            require_same_module(package, [*sys.path, os.getcwd()], f"names {name}")
        elif os.getcwd() not in sys.path and find_spec(package) is None:
            sys.path.append(os.getcwd())  # for good: processes that this one starts need it as well
        target = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"names {name}, which cannot be found, neither installed nor in {os.getcwd()}: {error}"
        ) from error
    if not callable(target):
        raise ConfigError(f"names {name}, which is not a class or function")
    return target


def _own_class(parts: Sequence[str]) -> Target | None:
    """Return one of the classes of this package that are made to be built; None for any other name."""
    *module, attribute = parts
    if any(part.startswith("_") for part in parts):
        return None
    try:
        target = getattr(import_module(".".join(module)), attribute, None)
    except ImportError:
        if module[1:2] == ["algorithms"] and len(module) == 3:  # as runs of before name those that have moved
            return _own_class([*module[:2], "contrib", module[2], attribute])
        return None
    return target if isclass(target) and _is_own(target) and issubclass(target, _buildable()) else None


@cache
def _buildable() -> tuple[type, ...]:
    return tuple(pkgutil.resolve_name(name) for name in (*GROUPS.values(), *_COMPONENTS))
