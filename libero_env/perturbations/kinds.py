"""Kinds of perturbations, and what is sampled from them: changes, plain values that can also be given as they are.

A change belongs to one of five layers, which are applied in the order of `LAYERS`: another `Task`, an `Appearance`, a
`StartChange`, an `ObservationFilter`, an `ActionFilter`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from libero_env.perturbations.sampling import SampleKey
from libero_env.sim.appearance import Appearance
from libero_env.sim.scene import Scene

Layer = Literal["problem", "appearance", "start", "observation", "action"]
LAYERS: tuple[Layer, ...] = get_args(Layer)


@dataclass
class Episode:
    """What a filter knows of one episode.

    Attributes:
        step: Number of control steps since the start.
        memory: What the filter remembers, by names of its own.
    """

    key: SampleKey
    step: int = 0
    memory: dict[str, Any] = field(default_factory=dict)


class StartChange(ABC):
    """A change of the state that an episode starts in."""

    layer: Layer = "start"

    @abstractmethod
    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        """Return the changed state, or None where it is not possible, such as with a collision.

        Args:
            row: State [time, qpos, qvel, poses of the fixtures]; it is not changed.
        """


class ObservationFilter:
    """A change of observations on their way to who acts. By default nothing changes.

    Attributes:
        only_rgb: Whether `image` is for images of colours only, and others arrive as they are.
        has_memory: Whether what arrives depends on earlier images, so that all of them must be rendered.
    """

    layer: Layer = "observation"
    only_rgb = has_memory = False

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return what arrives of an image.

        Args:
            name: Name of the observation, such as `agentview_rgb` or `agentview_depth`.
            image: The image, (H, W, ...); it is not changed.
            episode: Episode that it belongs to.
        """
        return image

    def state(self, entries: Mapping[str, np.ndarray], episode: Episode) -> Mapping[str, np.ndarray]:
        """Return what arrives of the entries that are not images, name -> (n,) float64."""
        return entries


class ActionFilter(ABC):
    """A change of actions on their way to the robot."""

    layer: Layer = "action"

    @abstractmethod
    def act(self, action: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the action (A,) that the robot executes.

        Args:
            action: Action that was chosen, (A,); it is not changed. The last number is the gripper's.
            episode: Episode that it belongs to; its step is the number of those before.
        """


Change = Appearance | StartChange | ObservationFilter | ActionFilter


def layer_of(change: Change) -> Layer:
    """Return the layer that a change belongs to."""
    return "appearance" if isinstance(change, Appearance) else change.layer


@dataclass(frozen=True)
class Kind:
    """A kind of perturbation.

    Attributes:
        name: Name, as in `camera=0.3`.
        layer: What it acts on; layers are applied in the order of `LAYERS`.
        unit: Unit of its amount.
        at_one: Amount at severity 1.
        what: What changes, in one sentence.
        sample: Function of the amount, a `SampleKey`'s generator and what the layer gives to it (a task and its scene,
            a scene, nothing) that returns the change.
        scale: How the amount grows: `linear`, in proportion to severity; `ratio`, from 1 in equal factors; `count`, in
            whole numbers from 1.
        physical: Whether what can be solved changes: physics, start, or actions.
        is_sampled: Whether anything is random, so that another sample may be solved where one is not.
        needs_materials: Whether scenes need spare materials, see `libero_env.sim.scene.build_scene`.
        exclusive: Whether no other kind of its layer may be named beside it.
    """

    name: str
    layer: Layer
    unit: str
    at_one: float
    what: str
    sample: Callable[..., Any]
    scale: Literal["linear", "ratio", "count"] = "linear"
    physical: bool = False
    is_sampled: bool = True
    needs_materials: bool = False
    exclusive: bool = False

    @property
    def is_rendered(self) -> bool:
        """Whether only what is seen or said changes, so that recorded states can be rendered with it."""
        return self.layer in ("appearance", "observation") or (self.layer == "problem" and not self.physical)

    @property
    def can_begin(self) -> bool:
        """Whether it can begin during an episode: without another scene, and without moving the arm."""
        return self.layer != "problem" and self.name not in ("robot", "object_pose")

    def amount(self, severity: float) -> float:
        """Return the amount at a severity in [0, 1], in `unit`."""
        if self.scale == "ratio":
            return float(self.at_one**severity)
        if self.scale == "count":
            return 0.0 if severity == 0 else float(max(1, round(severity * self.at_one)))
        return float(severity * self.at_one)
