"""Protocols by name, and the initial states that are used."""

from collections.abc import Iterator, Mapping, Sequence

from libero_env.init_states.store import NUM_INIT_STATES
from libero_eval.protocols.files import card_names, load_card
from libero_eval.protocols.protocol import Card
from lifelong.errors import ConfigError

# Initial states by which a checkpoint is chosen by default
SELECTION = range(NUM_INIT_STATES - 20, NUM_INIT_STATES)


class _Protocols(Mapping[str, Card]):
    """The package's cards by name, read when they are asked for."""

    def __getitem__(self, name: str) -> Card:
        if name not in card_names():
            raise KeyError(name)
        return load_card(name)

    def __iter__(self) -> Iterator[str]:
        return iter(card_names())

    def __len__(self) -> int:
        return len(card_names())


PROTOCOLS: Mapping[str, Card] = _Protocols()


def choose_init_states(
    which: str, count: int | None, selection: Sequence[int] = SELECTION
) -> tuple[int, ...]:
    """Return the indices of the initial states to evaluate.

    Args:
        which: `all`; `selection`: those by which a checkpoint may have been chosen; `reporting`: the others.
        count: Number of them, from the first on; None: all of them.
        selection: Initial states for selection.

    Raises:
        ConfigError: `which` is none of these, or there are fewer than `count`.
    """
    parts: dict[str, Sequence[int]] = {
        "all": range(NUM_INIT_STATES),
        "selection": selection,
        "reporting": [i for i in range(NUM_INIT_STATES) if i not in selection],
    }
    if which not in parts:
        raise ConfigError(f"starts are {which!r}; valid: {', '.join(parts)}")
    chosen = tuple(parts[which])
    count = len(chosen) if count is None else count
    if not 1 <= count <= len(chosen):
        raise ConfigError(f"{count} episodes of a task; {which} has 1 to {len(chosen)} initial states")
    return chosen[:count]
