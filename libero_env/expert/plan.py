"""From a goal to the skills that reach it, and the shapes they need to know."""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.geometry import Pose, surface_points
from libero_env.predicates import StateView, atoms_of
from libero_env.problem import Expression
from libero_env.scene import Scene


class UnsupportedGoalError(LiberoError):
    """A goal for which no skill exists; the message lists those that do."""


@dataclass(frozen=True)
class PickPlace:
    """Take an object and put it into a region (the site of a container)."""

    thing: str
    site: str
    container: str


def plan_goal(goal: Expression, scene: Scene) -> tuple[PickPlace, ...]:
    """The skills for a goal, one for each of its atoms.

    Raises:
        UnsupportedGoalError: an atom other than (In object site-of-an-object).
    """
    skills = []
    for atom in atoms_of(goal):
        container = _container(atom.args[-1], scene) if len(atom.args) == 2 else None
        if atom.predicate != "In" or container is None or atom.args[0] not in scene.objects:
            text = f"({atom.predicate} {' '.join(atom.args)})"
            raise UnsupportedGoalError(
                f"no skill reaches {text}; there is one for (In OBJECT SITE_OF_A_CONTAINER)"
            )
        skills.append(PickPlace(atom.args[0], atom.args[1], container))
    return tuple(skills)


def _container(address: str, scene: Scene) -> str | None:
    region = scene.problem.region(address)
    return (
        region.target if region is not None and not region.ranges and region.target in scene.objects else None
    )


class Shapes:
    """Points on the collision geoms of every object of a scene, each in its body's frame; computed once."""

    def __init__(self, scene: Scene):
        self._scene = scene

    @cached_property
    def fine(self) -> dict[str, np.ndarray]:
        """Name -> (N, 3), m; dense enough to measure widths."""
        return {name: self._points(name, 0.004) for name in self._scene.objects}

    @cached_property
    def coarse(self) -> dict[str, np.ndarray]:
        """Name -> (N, 3), m; enough to keep away from."""
        return {name: self._points(name, 0.02) for name in self._scene.objects}

    def cloud(self, view: StateView, name: str) -> np.ndarray:
        """Points on an object, world frame, (N, 3)."""
        return pose_of(view, name).apply(self.fine[name])

    def span(self, view: StateView, name: str) -> tuple[float, float]:
        """Lowest and highest point of an object, m."""
        pose = pose_of(view, name)
        heights = self.coarse[name] @ pose.mat[2] + pose.pos[2]
        return float(heights.min()), float(heights.max())

    def others(self, view: StateView, *names: str) -> np.ndarray:
        """Points on all objects but these, world frame, (M, 3)."""
        clouds = [
            pose_of(view, name).apply(points) for name, points in self.coarse.items() if name not in names
        ]
        return np.concatenate(clouds) if clouds else np.zeros((0, 3))

    def _points(self, name: str, spacing: float) -> np.ndarray:
        return surface_points(self._scene.model, self._scene.model.body(f"{name}_main").id, spacing)


def pose_of(view: StateView, name: str) -> Pose:
    """Pose of an object's root body."""
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, view.body_quat(name))
    return Pose(view.body_pos(name).copy(), mat.reshape(3, 3))
