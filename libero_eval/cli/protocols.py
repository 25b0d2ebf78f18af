"""`libero protocols`: the protocols by which policies are evaluated, and how they differ."""

from libero_env.cli.options import Positional
from libero_env.text import Table


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
    from libero_eval.protocols.naming import protocol_label, shown_values

    loaded = load_protocol(protocol)
    sources, section = loaded.sources, ""
    print(f"{protocol_label(loaded.resolved())}: {loaded.title} (digest {loaded.digest})")
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
    from libero_eval.protocols.naming import shown_values
    from libero_eval.protocols.protocol import CHANGED

    one, other = load_protocol(first), load_protocol(second)
    values, others = shown_values(one), shown_values(other)
    rows = [(name, value, others[name]) for name, value in values.items() if value != others[name]]
    if not rows:
        print(f"{one.name} and {other.name} are the same protocol ({one.digest})")
        return 0
    names = [one_of.name + (CHANGED if one_of.changes else "") for one_of in (one, other)]
    print(Table(("", *names), rows, 3))
    return 1
