"""Demonstrations by hand: from key events or a 3D mouse to actions, episodes and a demonstration file.

Nothing here knows of windows: a `Screen` feeds the device with what the user did and shows where things stand
(`libero_env.teleop.screens`). Keys and their effect are those of robosuite's keyboard device.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from libero_env.demos.observe import Filmer, Shots, model_file
from libero_env.demos.record import Recipe
from libero_env.demos.write import DemoWriter, Episode
from libero_env.envs.world import World
from libero_env.tasks import Task
from libero_env.teleop.devices import QUIT, Device

HOLD_STEPS = 10  # control steps that the goal must hold, as in the original
GENERATOR = "teleoperation"
VIEW = (480, 480)  # pixels of the pictures that screens ask the world for


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
