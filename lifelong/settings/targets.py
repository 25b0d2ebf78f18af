"""What a configuration may build: the names after `_target_`.

Whoever composes a configuration, on the command line or in files of his own, may name any class or function. A saved
configuration may be somebody else's. There, a name must be one of this package's classes that are made to be built, or
lie in a package that the user has allowed.
"""

import pkgutil
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from inspect import isclass
from typing import Any

from lifelong.errors import ConfigError

Target = Callable[..., Any]

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
    "wandb": "lifelong.tracking.Tracker",
}
# Components of algorithms and policies.
_COMPONENTS = (
    "lifelong.data.memory.ReplayMemory",
    "lifelong.algorithms.importance.ImportanceEstimator",
    "torch.nn.Module",
)
_PACKAGE = "lifelong"
# Modules and packages of this one in which these classes are.
_MODULES = (
    *(
        "lifelong.algorithms",
        "lifelong.data.memory",
        "lifelong.data.settings",
        "lifelong.evaluation.settings",
    ),
    *("lifelong.language", "lifelong.nn", "lifelong.policies", "lifelong.settings", "lifelong.streams"),
    *("lifelong.tracking", "lifelong.training.settings"),
)
# Packages that offer them too: the names in their `__init__`, not those of their other modules.
_OFFERS = ("lifelong.evaluation", "lifelong.training")


def group_kind(group: str) -> type:
    """Return the class that what a group builds is of."""
    kind = pkgutil.resolve_name(GROUPS[group])
    assert isclass(kind)
    return kind


def find_target(name: object, allowed: Sequence[str] | None = None) -> Target:
    """Return the class or function of a dotted name.

    Args:
        name: Value of `_target_`.
        allowed: Packages whose classes and functions a saved configuration may name beside this package's classes.
            None: the user has composed the configuration, and any name is valid.

    Raises:
        ConfigError: There is no such class or function, or it is not allowed.
    """
    if not isinstance(name, str) or len(name) > 200 or not _is_dotted(name):
        raise ConfigError(f"is {name!r}; expected the name of a class, such as {GROUPS['algo']}")
    if allowed is None:
        return _resolve(name)
    own = name.startswith(f"{_PACKAGE}.")
    found = _own_class(name) if own else _resolve(name) if _is_within(name, allowed) else None
    if found is None or not (
        own or _is_within(getattr(found, "__module__", None) or "", (*allowed, _PACKAGE))
    ):
        raise ConfigError(
            f"names {name}, which is no class that this package builds from a saved configuration"
            + (
                ""
                if own
                else f"; if you know and trust its code, allow it with --allow {name.partition('.')[0]}"
            )
        )
    return found


def _is_dotted(name: str) -> bool:
    parts = name.split(".")
    return len(parts) > 1 and all(part.isidentifier() for part in parts)


def _is_within(name: str, packages: Sequence[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def _resolve(name: str) -> Target:
    try:
        found = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"names {name}, which cannot be found: {error}") from error
    if not callable(found):
        raise ConfigError(f"names {name}, which is no class or function")
    return found


def _own_class(name: str) -> Target | None:
    """Return one of the classes of this package that are made to be built; None where the name is none."""
    module, _, attribute = name.rpartition(".")
    if not (_is_within(module, _MODULES) or module in _OFFERS) or any(
        p.startswith("_") for p in name.split(".")
    ):
        return None
    try:
        found = getattr(import_module(module), attribute, None)
    except ImportError:
        return None
    own = isclass(found) and _is_within(found.__module__, (_PACKAGE,)) and issubclass(found, _buildable())
    return found if own else None


@cache
def _buildable() -> tuple[type, ...]:
    return tuple(pkgutil.resolve_name(name) for name in (*GROUPS.values(), *_COMPONENTS))
