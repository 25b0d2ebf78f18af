"""Demonstrations by hand: from key events or a 3D mouse to actions, episodes and a demonstration file.

Nothing here knows of windows: a `Screen` feeds the device with what the user did and shows where things stand
(`libero_env.teleop_screens`). Keys and their effect are those of robosuite's keyboard device.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from libero_env.demos_film import Filmer, Shots, model_file
from libero_env.demos_studio import Recipe
from libero_env.demos_write import DemoWriter, Episode
from libero_env.tasks import Task
from libero_env.world import World

HOLD_STEPS = 10  # control steps that the goal must hold, as in the original
GENERATOR = "teleoperation"
VIEW = (480, 480)  # pixels of the pictures that screens ask the world for
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


@dataclass(frozen=True)
class Status:
    """What a screen shows beside the picture."""

    language: str
    progress: Mapping[str, bool]
    step: int
    recorded: int
    wanted: int

    def __str__(self) -> str:
        atoms = "  ".join(f"{atom} {'yes' if truth else 'no'}" for atom, truth in self.progress.items())
        return f"{self.language} | {atoms} | step {self.step} | {self.recorded} of {self.wanted} recorded"


class Screen(Protocol):
    """What the user looks at and acts on."""

    def poll(self, world: World) -> None:
        """Hand on to the device what the user did; once for each control step."""
        ...

    def show(self, world: World, status: Status) -> None:
        """Show the state, and wait until the control step has lasted 50 ms."""
        ...


@dataclass(frozen=True)
class Recording:
    """An episode that reached the goal: actions (T, 7), states before them (T, 1 + nq + nv), fixtures (n, 7)."""

    actions: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    fixtures: np.ndarray = field(repr=False)


class Teleop:
    """Episodes of a task under a user's hands.

    Args:
        task: the task.
        device: what the user acts through.
        screen: what the user looks at.
        seed: of the starts.
        hold_steps: control steps that the goal must hold before an episode counts.
    """

    def __init__(
        self, task: Task, device: Device, screen: Screen, *, seed: int = 0, hold_steps: int = HOLD_STEPS
    ):
        self.task, self.device, self.screen, self.seed, self.hold_steps = (
            task,
            device,
            screen,
            seed,
            hold_steps,
        )
        self.world = World(task, 1, cameras=(), camera_size=VIEW)
        self.rng = np.random.default_rng(seed)

    def episode(self, recorded: int = 0, wanted: int = 1) -> Recording | None:
        """One episode, until the goal has held for long enough; None where the user stops.

        When the user starts again, what was done so far is forgotten and things stand anew.

        Raises:
            PlacementError: things find no place.
        """
        while self.device.command != QUIT:
            self.device.command = None
            self.device.restart()
            self.world.reset_random([0], [self.rng])
            if (found := self._attempt(recorded, wanted)) is not None:
                return found
        return None

    def _attempt(self, recorded: int, wanted: int) -> Recording | None:
        world, actions, states, held = self.world, [], [], 0
        fixtures = world.simulations.fixtures[0].copy()
        while held < self.hold_steps:
            self.screen.poll(world)
            if self.device.command is not None:
                return None
            action = self.device.action()
            states.append(world.physics_state(0))
            actions.append(action)
            world.step([0], action[None])
            success, progress = world.judge(0)
            held = held + 1 if success else 0
            self.screen.show(world, Status(self.task.language, progress, len(actions), recorded, wanted))
        return Recording(np.array(actions), np.array(states), fixtures)

    def close(self) -> None:
        """Free the simulation."""
        self.world.close()


def record_by_hand(
    teleop: Teleop,
    path: Path,
    n: int,
    *,
    size: tuple[int, int] = (128, 128),
    tell: Callable[[str], None] = lambda _: None,
) -> int:
    """Record demonstrations into a file, each on disk before the next begins; goes on where it was stopped.

    Args:
        teleop: the task, device and screen.
        path: demonstration file to write.
        n: demonstrations that the file shall have.
        size: (height, width) of the pictures, pixels.
        tell: hears what was recorded.

    Returns:
        How many there are now; fewer than `n` where the user stopped.

    Raises:
        DemoError: the file cannot be written, or was made otherwise.
    """
    task = teleop.task
    shots = Shots(size=size)
    header = Recipe(task, size, teleop.seed, disturb=False).header() | {"generator": GENERATOR}
    writer = DemoWriter(path, header)
    done = writer.recorded()
    teleop.rng = np.random.default_rng([teleop.seed, len(done)])
    filmer = Filmer(task, shots)
    try:
        while len(done) < n and (found := teleop.episode(len(done), n)) is not None:
            number = max(done, default=-1) + 1
            obs, robot = filmer.film(found.states, found.fixtures)
            xml = model_file(task, tuple(filmer.scene.fixtures), found.fixtures)
            attrs = {"model_file": xml, "fixtures": found.fixtures}
            writer.write(number, Episode(found.actions, found.states, robot, obs, attrs=attrs))
            done.add(number)
            tell(f"demonstration {number}: {len(found.actions)} steps")
    finally:
        filmer.close()
    if done:
        writer.finish()
    return len(done)
