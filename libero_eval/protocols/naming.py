"""What a protocol is called: its name with all that was changed, and its values as text."""

from collections.abc import Collection, Mapping
from typing import Any

from libero_env.text import plain, shorten
from libero_eval.protocols.files import load_protocol, protocol_names
from libero_eval.protocols.protocol import FIELDS, EvalProtocol

# Keys of a protocol that follow from its values, or describe them
TOLD = ("digest", "title", "sources", "changes")


def protocol_label(stated: Mapping[str, Any], suites: Collection[str] = ()) -> str:
    """Return a protocol's name with all that differs: `openpi, changed: episode.horizon 6 (220)`.

    Everything that prints a protocol's name beside a number goes through here. A protocol that has the name of one of
    the package is compared with that, whatever it says of itself.

    Args:
        stated: The protocol as plain data, as in a result.
        suites: Suites whose horizons are told, of protocols that have one for each; by default all.
    """
    name = str(stated.get("name") or "unnamed protocol")
    values = flat_values(stated)
    if name in protocol_names():
        before = plain(load_protocol(name).flat())
    else:
        before = dict(changes) if isinstance(changes := stated.get("changes"), Mapping) else {}
    told = differing(values, before, suites)
    return f"{name}, changed: {', '.join(told)}" if told else name


def flat_values(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that a protocol as plain data states, by dotted name."""
    return {key: value for key in FIELDS if (value := _stated(stated, key)) is not _ABSENT}


def differing(
    values: Mapping[str, Any], before: Mapping[str, Any], suites: Collection[str] = ()
) -> list[str]:
    """Return the fields in which values differ from those before: `episode.horizon 6 (220)`, see `protocol_label`."""
    idle = [
        key
        for key, (other, state) in _IDLE.items()
        if values.get(key, 0) is None and values.get(other) == state
    ]
    return [
        f"{key} {horizon_text(values[key], suites)} ({horizon_text(before[key], suites)})"
        for key in values
        if key in before and values[key] != before[key] and key not in idle
    ]


def horizon_text(value: Any, suites: Collection[str]) -> str:
    """Return a value as text; of horizons by suite, those of the suites."""
    if isinstance(value, Mapping) and (of := {suite: value[suite] for suite in suites if suite in value}):
        first = next(iter(of.values()))
        value = first if all(one == first for one in of.values()) else of
    return shorten(show_value(value), 120) or "none"


def compared(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a protocol, as plain data, outcomes depend on, with its name."""
    return {key: value for key, value in stated.items() if key not in TOLD}


def section_of(stated: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a section of a protocol as plain data; an empty one where a result has none."""
    return part if isinstance(part := stated.get(name), Mapping) else {}


# Fields that mean nothing where another has a value
_IDLE = {
    "pixels.resize_size": ("pixels.resize", "none"),
    "episode.settle_action": ("episode.settle_steps", 0),
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("env_seed", "seeding", "loads")},
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("seed_per_start", "seed_per_task")},
    **{f"proprioception.{n}": ("proprioception.source", "none") for n in ("order", "rotation", "dtype")},
}
_ABSENT = object()


def _stated(stated: Mapping[str, Any], key: str) -> Any:
    section, _, field = key.partition(".")
    return plain(section_of(stated, section).get(field, _ABSENT))


def shown_values(protocol: EvalProtocol) -> dict[str, str]:
    """Return the values of a protocol as text, by dotted name; `-` where one means nothing beside the others."""
    values = protocol.flat()

    def is_idle(name: str) -> bool:
        other, value = _IDLE.get(name, (name, object()))
        return values[name] is None and values[other] == value

    return {name: "-" if is_idle(name) else show_value(value) for name, value in values.items()}


def show_value(value: Any) -> str:
    """Return a value as text; `not stated` for None."""
    if value is None:
        return "not stated"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return ", ".join(f"{str(k).removeprefix('libero_')} {v}" for k, v in value.items())
    if isinstance(value, tuple | list):
        return "[" + ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value) + "]"
    return repr(value) if isinstance(value, str) and "\n" in value else str(value)
