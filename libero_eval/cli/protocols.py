"""`libero protocols`: the protocols by which policies are evaluated, and how they differ."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from libero_env.cli.options import Positional
from libero_env.text import text_table

if TYPE_CHECKING:
    from libero_eval.protocols.protocol import EvalProtocol


def list_protocols() -> None:
    """Print name, digest and title of each protocol."""
    from libero_eval.protocols.files import load_protocol, protocol_names

    for name in protocol_names():
        protocol = load_protocol(name)
        print(f"{name:<14} {protocol.digest}  {protocol.title}")


def show(protocol: Positional[str]) -> None:
    """Print a protocol: each value, and the source of its section or of itself.

    Args:
        protocol: A protocol's name, a file of your own (my.yaml), or the result of an evaluation (eval.json).
    """
    from libero_eval.protocols.files import load_protocol

    loaded = load_protocol(protocol)
    sources, section = loaded.sources, ""
    print(f"{loaded.name}: {loaded.title} (digest {loaded.digest})")
    for name, value in shown_values(loaded).items():
        head, _, field = name.partition(".")
        if head != section:
            section = head
            print(f"\n{section}" + (f"  # {sources[section]}" if section in sources else ""))
        source = f"  # {sources[name]}" if name in sources else ""
        print(f"  {field:<18} {value}{source}")


def diff(first: Positional[str], second: Positional[str]) -> int:
    """Print the values in which two protocols differ, one a line; the exit status is 1 if any does.

    Args:
        first: A protocol's name, a file of your own (my.yaml), or the result of an evaluation (eval.json).
        second: The other one.
    """
    from libero_eval.protocols.files import load_protocol

    one, other = load_protocol(first), load_protocol(second)
    values, others = shown_values(one), shown_values(other)
    rows = [(name, value, others[name]) for name, value in values.items() if value != others[name]]
    if not rows:
        print(f"{one.name} and {other.name} are the same protocol ({one.digest})")
        return 0
    print(text_table([("", one.name, other.name), *rows], left=3))
    return 1


# Fields that mean nothing where another has a value
_IDLE = {
    "pixels.resize_size": ("pixels.resize", "none"),
    "episode.settle_action": ("episode.settle_steps", 0),
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("env_seed", "seeding", "loads")},
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("seed_per_start", "seed_per_task")},
    **{f"proprioception.{n}": ("proprioception.source", "none") for n in ("order", "rotation", "dtype")},
}


def shown_values(protocol: "EvalProtocol") -> dict[str, str]:
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
        return ", ".join(f"{k.removeprefix('libero_')} {v}" for k, v in value.items())
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value) + "]"
    return repr(value) if isinstance(value, str) and "\n" in value else str(value)
