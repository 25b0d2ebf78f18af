"""Kinds of perturbations, and what is sampled from them: changes, plain values that can also be given as they are.

A change belongs to one of five layers, which are applied in the order of `LAYERS`: another `Task`, an `Appearance`, a
`StartChange`, an `ObservationFilter`, an `ActionFilter`.

The random numbers of each sample depend on its name, so that they depend on no batch and no order. Samples of a name
are numbered from 0; used is the first for which the goal is false and that the expert solves, as far as that was
measured. `data/draws.json` has the numbers of those that replace earlier ones, by kind, severity, seed, task and start;
`libero perturb certify --keep` writes it.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from libero_env.storage import read_json

if TYPE_CHECKING:
    from libero_env.sim.scene import Scene

_overlay: dict[str, int] = {}


class SampleKey:
    """Name of a sample, from which generators are made.

    Args:
        *words: What the sample depends on, as texts and whole numbers.
    """

    def __init__(self, *words: object):
        self.words = words

    def generator(self, *words: object) -> np.random.Generator:
        """Return the generator of a part of the sample; the same words give the same numbers."""
        text = "\0".join(map(str, (*self.words, *words)))
        digest = hashlib.sha256(text.encode()).digest()
        return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))


def sample_key(kind: str, seed: int, task: str, start: object = "", attempt: int = 0) -> SampleKey:
    """Return the key of a sample. Severity is not part of it: a more severe one goes further in the same direction.

    Args:
        task: Id of the task without perturbations, such as `libero_goal/3`.
        start: Index of the initial state, or another name of the start; empty for samples of a whole task.
        attempt: Number of samples of these names that were not valid.
    """
    return SampleKey("libero perturbation", kind, seed, task, start, attempt)


def start_name(row: np.ndarray) -> str:
    """Return the name of a start that has no index: a digest of its state."""
    return hashlib.sha256(np.ascontiguousarray(row, "<f8").tobytes()).hexdigest()[:16]


def direction(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a vector (size,) of length 1 in a direction that is uniform on the sphere."""
    vector = rng.standard_normal(size)
    return vector / np.linalg.norm(vector)


def sign(rng: np.random.Generator) -> int:
    """Return -1 or 1."""
    return int(rng.integers(2)) * 2 - 1


def attempts_file() -> Path:
    """Return the file of the package with the numbers of samples."""
    return Path(str(resources.files("libero_env"))) / "perturbations" / "data" / "draws.json"


@cache
def _certified() -> Mapping[str, int]:
    return read_json(attempts_file())


def first_attempt(name: str) -> int:
    """Return the number of the first sample of a name that may be used, see `Perturbation.sample_name`."""
    return _overlay[name] if name in _overlay else _certified().get(name, 0)


@contextmanager
def trying(attempts: Mapping[str, int]) -> Iterator[None]:
    """Use other samples in the block.

    Args:
        attempts: Name of a sample -> number of the first that may be used.
    """
    before = dict(_overlay)
    _overlay.update(attempts)
    try:
        yield
    finally:
        _overlay.clear()
        _overlay.update(before)


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
    def apply(self, scene: "Scene", row: np.ndarray) -> np.ndarray | None:
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
            action: Action that was chosen, clipped to the action space, (A,); it is not changed. The last number is
                the gripper's.
            episode: Episode that it belongs to; its step is the number of those before.
        """


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
        only_rgb: Whether it changes images of colours and nothing else.
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
    only_rgb: bool = False
    exclusive: bool = False

    @property
    def is_rendered(self) -> bool:
        """Whether only what is seen or said changes, so that recorded states can be rendered with it."""
        return self.layer in ("appearance", "observation") or (self.layer == "problem" and not self.physical)

    @property
    def can_begin(self) -> bool:
        """Whether it can begin during an episode: without another scene, arm or half of the task."""
        return self.name == "goal" or (
            self.layer != "problem" and self.name not in ("robot", "object_pose", "partial")
        )

    def amount(self, severity: float) -> float:
        """Return the amount at a severity in [0, 1], in `unit`."""
        if self.scale == "ratio":
            return float(self.at_one**severity)
        if self.scale == "count":
            return 0.0 if severity == 0 else float(max(1, round(severity * self.at_one)))
        return float(severity * self.at_one)
