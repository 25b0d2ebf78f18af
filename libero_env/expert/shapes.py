"""Objects and fixtures of a scene as points on their surfaces."""

from functools import cache, cached_property, partial

import numpy as np

from libero_env.expert.arm import ArmKinematics
from libero_env.expert.clearance import obstacle_height
from libero_env.geometry import Pose, body_points, quat_to_mat, surface_points
from libero_env.sim.scene import Scene
from libero_env.sim.state import StateView

# [m] between points: to measure widths, to avoid obstacles, to fill voxels
FINE, COARSE, DENSE = 0.004, 0.02, 0.005


class Shapes:
    """Points on the collision geoms of all objects and fixtures, computed once and shared by the experts of a task."""

    def __init__(self, scene: Scene):
        self._scene = scene
        self._points_of_body = cache(partial(body_points, scene.model))

    @cached_property
    def arm(self) -> ArmKinematics:
        """Inverse kinematics of the scene's arm."""
        return ArmKinematics(self._scene.model)

    @cached_property
    def object_points(self) -> dict[str, np.ndarray]:
        """Points on each object in its own frame, (N, 3), [m]; dense enough to measure widths."""
        model = self._scene.model
        return {n: surface_points(model, model.body(f"{n}_main").id, FINE) for n in self._scene.objects}

    def cloud(self, view: StateView, name: str) -> np.ndarray:
        """Return the finely spaced points on an object, world frame, (N, 3)."""
        return pose_of(view, name).apply(self.object_points[name])

    def height_range(self, view: StateView, name: str) -> tuple[float, float]:
        """Return the heights of the lowest and the highest point of an object or fixture, [m]."""
        heights = self.points(view, name, COARSE)[:, 2]
        return float(heights.min()), float(heights.max())

    def obstacles(self, view: StateView, name: str, spacing: float = COARSE) -> np.ndarray:
        """Return points on all objects and fixtures except one, world frame, (M, 3)."""
        clouds = [self.points(view, other, spacing) for other in self._scene.entities if other != name]
        return np.concatenate([*clouds, np.zeros((0, 3))])

    def highest(self, view: StateView, name: str, *paths: tuple[np.ndarray, np.ndarray, float]) -> float:
        """Return the height of the highest obstacle near the first 10 cm of paths, [m]; see `obstacle_height`.

        Args:
            name: Object that is no obstacle.
            paths: Start (3,), end (3,) and radius of each, [m].
        """
        obstacles, surface = self.obstacles(view, name), view.scene.workspace.surface_height
        return max(obstacle_height(obstacles, *path, surface) for path in paths)

    def points(self, view: StateView, name: str, spacing: float) -> np.ndarray:
        """Return points on an object or fixture with its parts where they are now, world frame, (N, 3)."""
        pos, quat = (view.simulations.fields[key][view.index] for key in ("xpos", "xquat"))
        return np.concatenate(
            [
                Pose(pos[body], quat_to_mat(quat[body])).apply(self._points_of_body(int(body), spacing))
                for body in self._scene.bodies[name]
            ]
        )


def pose_of(view: StateView, name: str) -> Pose:
    """Return the pose of the root body of an object or fixture."""
    return Pose(view.body_pos(name), quat_to_mat(view.body_quat(name)))
