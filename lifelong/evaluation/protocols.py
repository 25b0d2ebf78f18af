"""Protocols of an evaluation: horizons, settling, image sizes, and the initial states that are used."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.tasks import Task
from lifelong.errors import ConfigError

# Initial states by which a checkpoint is chosen by default
SELECTION = range(NUM_INIT_STATES - 20, NUM_INIT_STATES)


@dataclass(frozen=True)
class EvalProtocol:
    """How episodes are run.

    Attributes:
        horizon: Maximum number of control steps, or that of each suite.
        settle_steps: Number of steps before the policy acts.
        settle_action: Action of these steps; None for zeros.
        camera_size: Image size (height, width), [pixels], for policies that do not define it.
        original: Whether observations have the names and flipped images of LIBERO's own environments.
    """

    horizon: int | Mapping[str, int] = 600
    settle_steps: int = 5
    settle_action: tuple[float, ...] | None = None
    camera_size: tuple[int, int] = (128, 128)
    original: bool = False

    def steps(self, task: Task) -> int:
        """Return the maximum number of control steps on a task."""
        if isinstance(self.horizon, int):
            return self.horizon
        return self.horizon.get(task.suite, max(self.horizon.values()))


# `libero`: Liu et al. 2023, appendix B. `openpi`: the evaluation scripts of openpi and OpenVLA-OFT.
PROTOCOLS = {
    "libero": EvalProtocol(),
    "openpi": EvalProtocol(
        horizon={
            "libero_spatial": 220,
            "libero_object": 280,
            "libero_goal": 300,
            "libero_10": 520,
            "libero_90": 400,
        },
        settle_steps=10,
        settle_action=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0),
        camera_size=(256, 256),
        original=True,
    ),
}


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
