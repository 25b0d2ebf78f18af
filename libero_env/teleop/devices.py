"""Input devices for teleoperation: what keys and a SpaceMouse mean as actions."""

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np

# Key -> (entry of the action, direction): position in the robot's frame, then rotation vector.
MOTIONS: Mapping[str, tuple[int, float]] = {
    "w": (0, -1.0),
    "s": (0, 1.0),
    "a": (1, -1.0),
    "d": (1, 1.0),
    "f": (2, -1.0),
    "r": (2, 1.0),
    "z": (3, -1.0),
    "x": (3, 1.0),
    "t": (4, 1.0),
    "g": (4, -1.0),
    "c": (5, -1.0),
    "v": (5, 1.0),
}


GRIPPER, RESET, QUIT = " ", "q", "escape"


HELP = (
    "w s: back, forth   a d: left, right   r f: up, down   z x, t g, c v: turn about x, y, z\n"
    "space: open or close the gripper   q: start again   escape: stop"
)


_KEY_POSITION, _KEY_ROTATION = 3.75, 0.15  # of an action per key, before it is cut at 1


_MOUSE_POSITION, _MOUSE_ROTATION = 0.625, 0.25  # likewise at full deflection


_MOUSE_RANGE = 350.0  # of a raw reading


_TAP_STEPS = 2  # that a key acts for which nobody reports the release of


class Device(Protocol):
    """What the user acts through."""

    command: str | None  # RESET or QUIT since it was last set to None

    def action(self) -> np.ndarray:
        """What is wanted for the next control step, (7,)."""
        ...

    def restart(self) -> None:
        """A new episode: nothing is pressed, the gripper is open."""
        ...


class Keyboard:
    """Key events to actions.

    Args:
        pos_sensitivity, rot_sensitivity: factors on motions and turns.
    """

    def __init__(self, pos_sensitivity: float = 1.0, rot_sensitivity: float = 1.0):
        self.gains = np.repeat([_KEY_POSITION * pos_sensitivity, _KEY_ROTATION * rot_sensitivity], 3)
        self.command: str | None = None
        self.restart()

    def restart(self) -> None:
        """See `Device`."""
        self.steps: dict[str, float] = {}  # key -> control steps that it still acts
        self.closed = False

    def press(self, key: str, *, held: bool = False) -> None:
        """A key goes down.

        Args:
            key: one of `MOTIONS`, `GRIPPER`, `RESET`, `QUIT`; others do nothing.
            held: its release will be told too; else it acts for 0.1 s, and again when it repeats.
        """
        key = key.lower()
        if key in MOTIONS:
            self.steps[key] = math.inf if held else _TAP_STEPS
        elif key == GRIPPER:
            self.closed = not self.closed
        elif key in (RESET, QUIT):
            self.command = key

    def release(self, key: str) -> None:
        """A key goes up. One that was pressed since the last step acts in the next step all the same."""
        if self.steps.get(key.lower()) == math.inf:
            self.steps[key.lower()] = 1

    def action(self) -> np.ndarray:
        """See `Device`."""
        motion = np.zeros(6)
        for key in self.steps:
            entry, direction = MOTIONS[key]
            motion[entry] += direction * self.gains[entry]
        self.steps = {key: left - 1 for key, left in self.steps.items() if left > 1}
        return np.append(np.clip(motion, -1.0, 1.0), 1.0 if self.closed else -1.0)


class SpaceMouse(Keyboard):
    """Reports of a 3Dconnexion mouse to actions: six axes; the left button closes the gripper while it is down, the
    right one starts again. Keys act, too.
    """

    def __init__(self, pos_sensitivity: float = 1.0, rot_sensitivity: float = 1.0):
        super().__init__(pos_sensitivity, rot_sensitivity)
        gains = (_MOUSE_POSITION * pos_sensitivity, _MOUSE_ROTATION * rot_sensitivity)
        self.mouse_gains = np.repeat(gains, 3)

    def restart(self) -> None:
        """See `Device`."""
        super().restart()
        self.deflection, self.button = np.zeros(6), False

    def report(self, data: bytes) -> None:
        """A report as the device sends it: number 1 moves (and turns), 2 turns on older ones, 3 are the buttons."""
        if len(data) < 2:
            return
        number, values = data[0], np.frombuffer(data[1 : 1 + (len(data) - 1) // 2 * 2], "<i2")
        if number == 3:
            self.button = data[1] == 1
            self.command = RESET if data[1] == 2 else self.command
            return
        scaled = np.clip(values / _MOUSE_RANGE, -1.0, 1.0)
        if number == 1 and len(scaled) >= 3:
            self.deflection[:3] = scaled[1], scaled[0], -scaled[2]
            scaled = scaled[3:]
        if number in (1, 2) and len(scaled) >= 3:
            self.deflection[3:] = scaled[1], scaled[0], -scaled[2]

    def action(self) -> np.ndarray:
        """See `Device`."""
        action = super().action()
        action[:6] = np.clip(action[:6] + self.deflection * self.mouse_gains, -1.0, 1.0)
        action[6] = 1.0 if self.button or self.closed else -1.0
        return action
