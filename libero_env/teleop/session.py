"""Teleoperated demonstrations: from keys and a 3D mouse to actions, episodes and a demonstration file.

Nothing here depends on windows: a `Screen` passes the user's input to the device and shows the state of the episode
(`libero_env.teleop.screens`).
"""

import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from libero_env.demos.config import DemoConfig
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import Episode
from libero_env.demos.write import DemoWriter
from libero_env.envs.batch import BatchEnv
from libero_env.tasks import Task

# Keys that make each entry of an action smaller and larger: of the translation in the robot's frame, then of the
# rotation vector.
_PAIRS = ("ws", "ad", "fr", "zx", "gt", "cv")
# Key -> (index in the action, sign)
MOTIONS: Mapping[str, tuple[int, float]] = {
    key: (index, sign)
    for index, pair in enumerate(_PAIRS)
    for key, sign in zip(pair, (-1.0, 1.0), strict=True)
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
        pos_sensitivity: Factor on translations; from 0.27 on a key moves the hand as fast as an action can.
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

    def poll(self) -> None:
        """Read what the device has to report; keys come from the screen."""

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


HOLD_STEPS = 10  # [control steps] during which the goal must hold, as in the original
GENERATOR = "teleoperation"
VIEW_SIZE = (480, 480)  # [pixels] height and width of the images that screens render


@dataclass(frozen=True)
class Status:
    """State of the session, which a screen shows beside the image.

    Attributes:
        language: The instruction.
        progress: Whether each atom of the goal is true.
        step: Number of control steps in the episode.
        target: Number of demonstrations to record.
    """

    language: str
    progress: Mapping[str, bool]
    step: int
    recorded: int
    target: int

    def __str__(self) -> str:
        atoms = "  ".join(f"{atom} {'yes' if truth else 'no'}" for atom, truth in self.progress.items())
        return f"{self.language} | {atoms} | step {self.step} | {self.recorded} of {self.target} recorded"


class Screen(Protocol):
    """What the user looks at and types into."""

    def poll(self, env: BatchEnv) -> None:
        """Pass the keys that the user has pressed to the device; called once per control step."""

    def show(self, env: BatchEnv, status: Status) -> None:
        """Show the state, and wait until the control step has lasted 50 ms."""

    def close(self) -> None:
        """Close the screen and restore what it changed."""


class Teleop:
    """Episodes of a task that a user drives.

    Args:
        device: Input device of the user.
        screen: What the user looks at.
        seed: Seed of the starts.
    """

    def __init__(self, task: Task, device: Keyboard, screen: Screen, *, seed: int = 0):
        self.task, self.device, self.screen = task, device, screen
        self.seed = seed
        self.env = BatchEnv(task, 1, cameras=(), camera_size=VIEW_SIZE)
        self.rng = np.random.default_rng(seed)

    def episode(self, recorded: int = 0, target: int = 1) -> Episode | None:
        """Run an episode until the goal has held for long enough.

        When the user restarts it, what was done so far is dropped and a new start is sampled.

        Args:
            recorded: Number of demonstrations that are recorded, for the screen.
            target: Number of demonstrations to record, for the screen.

        Returns:
            The episode, without observations; None if the user stops.

        Raises:
            PlacementError: No placement of the objects was found.
        """
        while self.device.command != QUIT:
            self.device.command = None
            self.device.restart()
            self.env.generators[0] = self.rng
            self.env.reset()
            if (episode := self._attempt(recorded, target)) is not None:
                return episode
        return None

    def _attempt(self, recorded: int, target: int) -> Episode | None:
        """Run an episode; return None when the user gives a command."""
        env, actions, states, held = self.env, [], [], 0
        fixtures = env.simulations.fixtures[0].copy()
        while held < HOLD_STEPS:
            self.screen.poll(env)
            self.device.poll()
            if self.device.command is not None:
                return None
            action = self.device.action()
            states.append(env.simulations.physics_state(0))
            actions.append(action)
            env.simulations.step([0], action[None])
            success, progress = env.check_goal(0)
            held = held + 1 if success else 0
            self.screen.show(env, Status(self.task.language, progress, len(actions), recorded, target))
        return Episode(np.array(actions), np.array(states), fixtures=fixtures)

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()


def record_session(
    teleop: Teleop,
    path: Path,
    n: int,
    *,
    size: tuple[int, int] = (128, 128),
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Record teleoperated demonstrations into a file; each is on the disk before the next one begins.

    Args:
        teleop: The task, device and screen.
        path: Demonstration file to write. Demonstrations that it has already are kept.
        n: Number of demonstrations that the file shall have.
        size: (height, width) of the images, pixels.
        report: Called with a line of text about each demonstration.

    Returns:
        Number of demonstrations in the file; fewer than `n` if the user stopped.

    Raises:
        DemoError: The file cannot be written, or was recorded with another configuration.
    """
    config = DemoConfig(teleop.task, size, teleop.seed, disturb=False)
    writer = DemoWriter(path, config.header() | {"generator": GENERATOR})
    recorded = writer.recorded()
    teleop.rng = np.random.default_rng([teleop.seed, len(recorded)])
    with closing(StateRenderer(teleop.task, config.render_config)) as renderer:
        while len(recorded) < n and (episode := teleop.episode(len(recorded), n)) is not None:
            number = max(recorded, default=-1) + 1
            assert episode.fixtures is not None  # `Teleop` records them
            obs, robot_states = renderer.render_states(episode.states, episode.fixtures)
            attrs = {"model_file": renderer.model_xml(episode.fixtures)}
            writer.write(number, replace(episode, obs=obs, robot_states=robot_states, attrs=attrs))
            recorded.add(number)
            report(f"demonstration {number}: {len(episode)} steps")
    if recorded:
        writer.finish()
    return len(recorded)
