"""Parts of an approach that several skills share: the funnel, and backing off from an obstacle."""

import numpy as np


class BackOff:
    """Detection of a finger that stands on something; the hand then goes back until it is clear.

    Attributes:
        active: Whether the hand goes back.
        count: Number of times that the hand went back.
    """

    def __init__(self) -> None:
        self.active, self.count, self._standing_steps = False, 0, 0

    def update(self, *, standing: bool, clear: bool) -> None:
        """Go back after three steps of standing, until the hand is clear.

        Args:
            standing: Whether the hand is further away than intended, and hardly moves.
            clear: Whether the fingers are clear of the object and the hand is over its target.
        """
        self._standing_steps = self._standing_steps + 1 if standing else 0
        if self._standing_steps >= 3 and not self.active:
            self.active, self.count = True, self.count + 1
        if clear:
            self.active = False

    def stop(self) -> None:
        """Stop going back; the count stays."""
        self.active, self._standing_steps = False, 0


def funnel_lift(slope: float, distance: float, angle: float, largest: float) -> float:
    """Return how far a hand stays back from its target, so that it approaches within a funnel, [m].

    Args:
        slope: Slope of the funnel.
        distance: Lateral distance from the target beyond the tolerance, [m].
        angle: Angle from the target orientation beyond the tolerance, [rad].
        largest: Height of the funnel, [m].
    """
    return float(np.clip(slope * distance + 0.3 * max(angle, 0.0), 0.0, largest))
