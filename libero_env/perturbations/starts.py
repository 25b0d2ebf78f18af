"""Kinds that change the start of an episode: the joints of the arm, the poses of objects."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from libero_env.init_states.store import split_row
from libero_env.perturbations.drawing import direction
from libero_env.perturbations.kind import Kind
from libero_env.sim.scene import Scene

_LIMIT_MARGIN = 0.02  # [rad] between a drawn joint and the end of its range


class StartChange(ABC):
    """A change of the state that an episode starts in."""

    @abstractmethod
    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        """Return the changed state, or None where it is not possible, such as with a collision.

        Args:
            scene: Scene of the task.
            row: State [time, qpos, qvel, poses of the fixtures]; it is not changed.
        """


@dataclass(frozen=True)
class RobotJoints(StartChange):
    """Joints of the arm.

    Attributes:
        qpos: Positions of the seven joints, [rad].
    """

    qpos: tuple[float, ...]

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        """Return the state with these joints; see `StartChange`."""
        return _with_arm(row, np.asarray(self.qpos))


@dataclass(frozen=True)
class RobotOffset(StartChange):
    """An offset of the arm's joints that must be within their ranges and without new contacts.

    Attributes:
        offset: What is added to the positions of the seven joints, [rad].
    """

    offset: tuple[float, ...]

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        """Return the state with the offset; see `StartChange`."""
        model, arm = scene.model, row[1:8] + self.offset
        low, high = model.jnt_range[:7].T
        if not ((arm > low + _LIMIT_MARGIN) & (arm < high - _LIMIT_MARGIN)).all():
            return None
        moved = _with_arm(row, arm)
        return moved if contacts(scene, moved) <= contacts(scene, row) else None


def _with_arm(row: np.ndarray, arm: np.ndarray) -> np.ndarray:
    moved = row.copy()
    moved[1 : 1 + len(arm)] = arm
    return moved


_geometry: "WeakKeyDictionary[mujoco.MjModel, tuple[mujoco.MjModel, mujoco.MjData]]" = WeakKeyDictionary()


def contacts(scene: Scene, row: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs of bodies that touch in a state [time, qpos, qvel, poses of the fixtures]."""
    model, data = posed(scene, row)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    bodies: Sequence[Sequence[int]] = np.sort(model.geom_bodyid[data.contact.geom[: data.ncon]]).tolist()
    return {(a, b) for a, b in bodies}


def posed(scene: Scene, row: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a copy of the model with the poses of the fixtures, and data with the positions."""
    if scene.model not in _geometry:
        model = copy(scene.model) if scene.fixtures else scene.model
        _geometry[scene.model] = model, mujoco.MjData(model)
    model, data = _geometry[scene.model]
    qpos, _, fixtures = split_row(model, row[None])
    if scene.fixtures:
        model.body_pos[scene.fixture_bodies] = fixtures[0, :, :3]
        model.body_quat[scene.fixture_bodies] = fixtures[0, :, 3:]
    data.qpos[:] = qpos[0]
    return model, data


def _robot(radians: float, rng: np.random.Generator, scene: Scene) -> RobotOffset:
    return RobotOffset(tuple((radians * direction(rng, 7)).tolist()))


KINDS = (
    Kind(
        "robot",
        "start",
        "rad",
        0.5,
        "the arm starts elsewhere, at this distance in joint space, within its limits and touching nothing",
        _robot,
        physical=True,
    ),
)
