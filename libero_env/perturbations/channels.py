"""Filters between an environment and who acts in it: on observations and on actions, one channel for each episode."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from libero_env.perturbations.drawing import DrawKey


class ObservationChannel:
    """The observations of one episode on their way to who acts. By default nothing changes."""

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        """Return what arrives of an image.

        Args:
            name: Name of the observation, such as `agentview_rgb` or `agentview_depth`.
            image: The image, (H, W, ...); it is not changed.
            step: Number of control steps since the start of the episode.
        """
        return image

    def state(self, entries: Mapping[str, np.ndarray], step: int) -> Mapping[str, np.ndarray]:
        """Return what arrives of the entries that are no images, name -> (n,) float64."""
        return entries


class ObservationFilter(ABC):
    """A change of observations, a plain value; each episode has a channel of its own.

    Attributes:
        has_memory: Whether what arrives depends on earlier images, so that all of them must be drawn.
    """

    has_memory = False

    @abstractmethod
    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode, which draws its random numbers from `key`."""


class ActionChannel(ABC):
    """The actions of one episode on their way to the robot."""

    @abstractmethod
    def act(self, action: np.ndarray, step: int) -> np.ndarray:
        """Return the action (A,) that the robot executes.

        Args:
            action: Action that was chosen, (A,); it is not changed. The last number is the gripper's.
            step: Number of control steps before this one.
        """


class ActionFilter(ABC):
    """A change of actions, a plain value; each episode has a channel of its own."""

    @abstractmethod
    def open(self, key: DrawKey) -> ActionChannel:
        """Return the channel of an episode, which draws its random numbers from `key`."""
