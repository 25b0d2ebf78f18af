"""Teleoperated demonstrations: from the actions of an input device to episodes and a demonstration file.

Nothing here depends on windows: a `Screen` passes the user's input to the device and shows the state of the episode
(`libero_env.teleop.screens`).
"""

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
from libero_env.teleop.devices import QUIT, Keyboard

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
        """Pass the user's input to the device; called once per control step."""
        ...

    def show(self, env: BatchEnv, status: Status) -> None:
        """Show the state, and wait until the control step has lasted 50 ms."""
        ...

    def close(self) -> None:
        """Close the screen and restore what it changed."""
        ...


class Teleop:
    """Episodes of a task that a user drives.

    Args:
        device: Input device of the user.
        screen: What the user looks at.
        seed: Seed of the starts.
        hold_steps: Number of control steps during which the goal must hold before the episode ends.
    """

    def __init__(
        self, task: Task, device: Keyboard, screen: Screen, *, seed: int = 0, hold_steps: int = HOLD_STEPS
    ):
        self.task, self.device, self.screen = task, device, screen
        self.seed, self.hold_steps = seed, hold_steps
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
        while held < self.hold_steps:
            self.screen.poll(env)
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
