"""Input devices of teleoperation: how keys and a 3D mouse become actions."""

import math
from collections.abc import Mapping

import numpy as np

# Key -> (index in the action, sign): translation in the robot's frame, then rotation vector.
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
    "space: open or close the gripper   q: restart the episode   escape: stop"
)

_KEY_TRANSLATION, _KEY_ROTATION = 3.75, 0.15  # [action units] of one key, before clipping to 1
_MOUSE_TRANSLATION, _MOUSE_ROTATION = 0.625, 0.25  # [action units] at full deflection
_MOUSE_RANGE = 350.0  # [raw units] reading at full deflection
_TAP_STEPS = 2  # [control steps] during which a key acts whose release is not reported


class Keyboard:
    """Turns key events into actions; the keys and their effect are those of robosuite's keyboard device.

    Args:
        pos_sensitivity: Factor on translations.
        rot_sensitivity: Factor on rotations.

    Attributes:
        command: `RESET` or `QUIT` if the user gave that command since it was last set to None.
    """

    def __init__(self, pos_sensitivity: float = 1.0, rot_sensitivity: float = 1.0):
        self.gains = np.repeat([_KEY_TRANSLATION * pos_sensitivity, _KEY_ROTATION * rot_sensitivity], 3)
        self.command: str | None = None
        self.restart()

    def restart(self) -> None:
        """Prepare for a new episode: no key is pressed, the gripper is open."""
        self.steps: dict[str, float] = {}  # pressed key -> control steps during which it still acts
        self.closed = False

    def press(self, key: str, *, held: bool = False) -> None:
        """Handle the press of a key.

        Args:
            key: One of `MOTIONS`, `GRIPPER`, `RESET`, `QUIT`; others have no effect.
            held: Whether the release of the key will be reported. If not, the key acts for 0.1 s, and again when it
                repeats.
        """
        key = key.lower()
        if key in MOTIONS:
            self.steps[key] = math.inf if held else _TAP_STEPS
        elif key == GRIPPER:
            self.closed = not self.closed
        elif key in (RESET, QUIT):
            self.command = key

    def release(self, key: str) -> None:
        """Handle the release of a key. A key pressed since the last step still acts in the next one."""
        if self.steps.get(key.lower()) == math.inf:
            self.steps[key.lower()] = 1

    def action(self) -> np.ndarray:
        """Return the action for the next control step, (7,)."""
        motion = np.zeros(6)
        for key in self.steps:
            index, sign = MOTIONS[key]
            motion[index] += sign * self.gains[index]
        self.steps = {key: left - 1 for key, left in self.steps.items() if left > 1}
        return np.append(np.clip(motion, -1.0, 1.0), 1.0 if self.closed else -1.0)


class SpaceMouse(Keyboard):
    """Turns the reports of a 3Dconnexion mouse into actions; keys act as well.

    Its six axes move the gripper. The left button closes the gripper while it is pressed, the right button restarts
    the episode.

    Args:
        pos_sensitivity: Factor on translations.
        rot_sensitivity: Factor on rotations.
    """

    def __init__(self, pos_sensitivity: float = 1.0, rot_sensitivity: float = 1.0):
        super().__init__(pos_sensitivity, rot_sensitivity)
        gains = (_MOUSE_TRANSLATION * pos_sensitivity, _MOUSE_ROTATION * rot_sensitivity)
        self.mouse_gains = np.repeat(gains, 3)

    def restart(self) -> None:
        """Prepare for a new episode."""
        super().restart()
        self.deflection, self.button = np.zeros(6), False

    def report(self, data: bytes) -> None:
        """Handle a report of the device.

        Args:
            data: Its bytes. The first is the kind: 1 is translation, with rotation on newer devices, 2 is rotation on
                older ones, 3 is the buttons.
        """
        if len(data) < 2:
            return
        kind, values = data[0], np.frombuffer(data[1 : 1 + (len(data) - 1) // 2 * 2], "<i2")
        if kind == 3:
            self.button = data[1] == 1
            self.command = RESET if data[1] == 2 else self.command
            return
        scaled = np.clip(values / _MOUSE_RANGE, -1.0, 1.0)
        if kind == 1 and len(scaled) >= 3:
            self.deflection[:3] = scaled[1], scaled[0], -scaled[2]
            scaled = scaled[3:]
        if kind in (1, 2) and len(scaled) >= 3:
            self.deflection[3:] = scaled[1], scaled[0], -scaled[2]

    def action(self) -> np.ndarray:
        action = super().action()
        action[:6] = np.clip(action[:6] + self.deflection * self.mouse_gains, -1.0, 1.0)
        action[6] = 1.0 if self.button or self.closed else -1.0
        return action
