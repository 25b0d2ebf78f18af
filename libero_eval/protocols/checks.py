"""Checks of protocol cards: the type of each value, and values that contradict each other."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from libero_env.errors import LiberoError

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
ACTION_DIM = 7
_MOST = {  # what no protocol means, and no machine does in a life
    "episode.settle_steps": 10_000,
    "episode.horizon": 1_000_000,
    "pixels.render_size": 1024,
    "pixels.resize_size": 4096,
    "counting.trials": 1_000_000,
    "world.env_seed": 2**32 - 1,
    "world.loads": 10_000,
}


def type_errors(card: Any) -> list[str]:
    """Return what is wrong with the types of a card's values, one text for each, empty if nothing is."""
    return list(_type_errors(card, ""))


def _type_errors(part: Any, prefix: str) -> Iterator[str]:
    hints = get_type_hints(type(part))
    for field in fields(part):
        value, hint = getattr(part, field.name), hints[field.name]
        if is_dataclass(value):
            yield from _type_errors(value, f"{field.name}.")
        elif not _matches(value, hint):
            yield f"{prefix}{field.name} is {value!r}; expected {describe(hint)}"


def _matches(value: Any, hint: Any) -> bool:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_matches(value, part) for part in args)
    if origin is Literal:
        return isinstance(value, str) and value in args
    if origin is tuple and args[-1] is Ellipsis:
        return isinstance(value, tuple) and all(_matches(v, args[0]) for v in value)
    if origin is tuple:
        return isinstance(value, tuple) and len(value) == len(args) and all(map(_matches, value, args))
    if origin is not None and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            _matches(k, args[0]) and _matches(v, args[1]) for k, v in value.items()
        )
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and -math.inf < value < math.inf
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return value is None if hint is type(None) else isinstance(value, hint)


def describe(hint: Any) -> str:
    """Return what a type means, for messages: `one of once, every_reset, or null`."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return ", or ".join(describe(part) for part in args)
    if origin is Literal:
        return f"one of {', '.join(args)}"
    if origin is tuple:
        count = "" if args[-1] is Ellipsis else f"{len(args)} "
        return f"a list: {count}times {describe(args[0])}"
    if origin is not None:
        return f"{describe(args[0])} -> {describe(args[1])}"
    names = {int: "a whole number", float: "a number", str: "text", bool: "true or false", type(None): "null"}
    return names.get(hint, str(hint))


def contradictions(v: Mapping[str, Any]) -> list[str]:
    """Return which values contradict each other, or cannot be; one text for each.

    Args:
        v: Values by dotted name.
    """
    found = [text for text in (*_episode(v), *_pixels(v), *_action(v), *_world(v)) if text]
    for name in (
        "sampling.denoising_steps",
        "sampling.batch",
        "counting.tasks",
        "counting.trials",
        "action.chunk",
    ):
        if v[name] is not None and v[name] < 1:
            found.append(f"{name} is {v[name]}; it must be at least 1")
    for name, most in _MOST.items():
        given = v[name].values() if isinstance(v[name], Mapping) else v[name]
        for value in given if isinstance(given, Iterable) else (given,):
            if value is not None and value > most:
                found.append(f"{name} is {value}; it must be at most {most}")
    if "{instruction}" not in v["language.template"]:
        found.append(f"language.template is {v['language.template']!r}; it must have {{instruction}}")
    return found


def _episode(v: Mapping[str, Any]) -> Iterator[str]:
    settle, action, horizon = v["episode.settle_steps"], v["episode.settle_action"], v["episode.horizon"]
    if settle == 0 and action is not None:
        yield f"episode.settle_action is {list(action)}, but episode.settle_steps is 0"
    if settle is not None and settle < 0:
        yield f"episode.settle_steps is {settle}; it must be at least 0"
    if action is not None and len(action) != ACTION_DIM:
        yield f"episode.settle_action has {len(action)} numbers; expected {ACTION_DIM}"
    if settle == 0 and v["episode.settle_counted"]:
        yield "episode.settle_counted is true, but episode.settle_steps is 0"
    if isinstance(horizon, Mapping) and (missing := [s for s in SUITES if s not in horizon]):
        yield f"episode.horizon has no value for {', '.join(missing)}"
    steps = horizon.values() if isinstance(horizon, Mapping) else () if horizon is None else (horizon,)
    least = 1 + (settle or 0) * v["episode.settle_counted"]
    if low := [n for n in steps if n < least]:
        yield f"episode.horizon is {low[0]}; it must be at least {least}"
    order = v["episode.reset_order"]
    if "set_init_state" not in order or len(set(order)) != len(order):
        yield f"episode.reset_order is {list(order)}; it must have set_init_state, and each call once"
    elif "reset" in order and order.index("reset") > order.index("set_init_state"):
        yield "episode.reset_order has reset after set_init_state, which would undo it"


def _pixels(v: Mapping[str, Any]) -> Iterator[str]:
    resize, size, crop = v["pixels.resize"], v["pixels.resize_size"], v["pixels.crop"]
    if not v["pixels.cameras"] or len(set(v["pixels.cameras"])) != len(v["pixels.cameras"]):
        yield f"pixels.cameras is {list(v['pixels.cameras'])}; expected each camera once"
    if resize == "none" and size is not None:
        yield f"pixels.resize_size is {list(size)}, but pixels.resize is none"
    if resize not in (None, "none") and size is None:
        yield f"pixels.resize is {resize}, but pixels.resize_size is null"
    if crop is not None and not 0 < crop <= 1:
        yield f"pixels.crop is {crop}; it is a share of the area, over 0 and at most 1"
    if crop is not None and crop < 1 and resize in (None, "none"):
        yield f"pixels.crop is {crop}, but pixels.resize is {resize or 'null'}: nothing says to which size"
    for name in ("pixels.render_size", "pixels.resize_size"):
        if v[name] is not None and min(v[name]) < 1:
            yield f"{name} is {list(v[name])}; edges must be at least 1"


def _action(v: Mapping[str, Any]) -> Iterator[str]:
    chunk, replan = v["action.chunk"], v["action.replan"]
    if replan is not None and replan < 1:
        yield f"action.replan is {replan}; it must be at least 1"
    if chunk is not None and replan is not None and replan > chunk:
        yield f"action.replan is {replan}, but action.chunk is {chunk}: there are not as many actions"
    source, order = v["proprioception.source"], v["proprioception.order"]
    if source == "none" and order:
        yield f"proprioception.order is {list(order)}, but proprioception.source is none"
    if source == "observation":
        if not order:
            yield "proprioception.source is observation, but proprioception.order is empty"
        for name in ("rotation", "dtype"):
            if v[f"proprioception.{name}"] is None:
                yield f"proprioception.source is observation, but proprioception.{name} is null"


def _world(v: Mapping[str, Any]) -> Iterator[str]:
    if v["world.perturb"]:
        yield from _perturbations(v["world.perturb"])
    if v["world.fixture_poses"] == "stored" and v["world.env_seed"] is not None:
        yield f"world.env_seed is {v['world.env_seed']}, but world.fixture_poses are stored: nothing is drawn"
    if v["world.fixture_poses"] == "drawn" and "reset" not in v["episode.reset_order"]:
        yield "world.fixture_poses are drawn, but episode.reset_order has no reset, which draws them"
    if v["world.seeding"] == "once":
        for name in ("world.seed_per_start", "world.seed_per_task"):
            if v[name]:
                yield f"{name} is {v[name]}, but world.seeding is once"
    if v["world.env_seed"] is not None and v["world.env_seed"] < 0:
        yield f"world.env_seed is {v['world.env_seed']}; it must be at least 0"
    if v["world.control_freq"] != 20:
        yield f"world.control_freq is {v['world.control_freq']}; the benchmark runs at 20 Hz"


def _perturbations(text: str) -> Iterator[str]:
    from libero_env.perturbations.value import format_perturbations, parse_perturbations  # slow to import

    try:
        if text != (plain := format_perturbations(parse_perturbations(text))):
            yield f"world.perturb is {text!r}; in the order of application it is {plain!r}"
    except LiberoError as error:
        yield f"world.perturb: {error}"
