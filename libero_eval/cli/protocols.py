"""`libero protocols`: the protocols by which policies are evaluated, and how they differ."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from libero_env.cli.arguments import Subparsers

if TYPE_CHECKING:
    from libero_eval.protocols.protocol import Card

CARD_HELP = "a protocol's name, a card of your own (my.yaml), or the result of an evaluation (eval.json)"


def register(subparsers: Subparsers) -> None:
    """Add the commands `libero protocols list`, `show` and `diff`."""
    parser = subparsers.add_parser(
        "protocols", help="how policies are evaluated: LIBERO's paper, openpi, LeRobot, ..."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the protocols of the package")
    listing.set_defaults(run=run_list)
    show = commands.add_parser("show", help="all values of a protocol, and where they stand")
    show.add_argument("protocol", metavar="CARD", help=CARD_HELP)
    show.set_defaults(run=run_show)
    diff = commands.add_parser("diff", help="the values in which two protocols differ")
    for name in ("first", "second"):
        diff.add_argument(name, metavar="CARD", help=CARD_HELP)
    diff.set_defaults(run=run_diff)


def run_list(args: argparse.Namespace) -> None:
    """Print name, digest and title of each protocol."""
    from libero_eval.protocols.files import card_names, load_card

    for name in card_names():
        card = load_card(name)
        print(f"{name:<14} {card.digest}  {card.title}")


def run_show(args: argparse.Namespace) -> None:
    """Print a protocol: each value, and the source of its section or of itself."""
    from libero_eval.protocols.files import load_card

    card = load_card(args.protocol)
    print(f"{card.name}: {card.title} (digest {card.digest})")
    section = ""
    for name, value in shown_values(card).items():
        head, _, field = name.partition(".")
        if head != section:
            section = head
            print(f"\n{section}" + (f"  # {card.sources[section]}" if section in card.sources else ""))
        source = f"  # {card.sources[name]}" if name in card.sources else ""
        print(f"  {field:<18} {value}{source}")


def run_diff(args: argparse.Namespace) -> int:
    """Print the values that differ, one a line; return 1 if any does."""
    from libero_eval.protocols.files import load_card

    first, second = load_card(args.first), load_card(args.second)
    ours, theirs = shown_values(first), shown_values(second)
    rows = [(name, value, theirs[name]) for name, value in ours.items() if value != theirs[name]]
    if not rows:
        print(f"{first.name} and {second.name} are the same protocol ({first.digest})")
        return 0
    table = [("", first.name, second.name), *rows]
    widths = [max(len(row[k]) for row in table) for k in (0, 1)]
    for name, one, other in table:
        print(f"{name:<{widths[0]}}  {one:<{widths[1]}}  {other}")
    return 1


# Fields that mean nothing where another has a value
_IDLE = {
    "pixels.resize_size": ("pixels.resize", "none"),
    "episode.settle_action": ("episode.settle_steps", 0),
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("env_seed", "seeding", "loads")},
    **{f"world.{n}": ("world.fixture_poses", "stored") for n in ("seed_per_start", "seed_per_task")},
    **{f"proprioception.{n}": ("proprioception.source", "none") for n in ("order", "rotation", "dtype")},
}


def shown_values(card: "Card") -> dict[str, str]:
    """Return the values of a card as text, by dotted name; `-` where one means nothing beside the others."""
    values = {name: value for name, value in card.flat().items() if "." in name}

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
