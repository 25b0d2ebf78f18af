"""The shapes of a scene's things as points, in their bodies' frames and where they are now."""

from functools import cached_property

import numpy as np

from libero_env.expert.arm.reach import Arm
from libero_env.geometry import Pose, body_points, quat_to_mat, surface_points
from libero_env.sim.scene import Scene
from libero_env.sim.state import StateView

FINE, COARSE, DENSE = (
    0.004,
    0.02,
    0.005,
)  # m between points: to measure widths, to keep away from, to fill voxels


class Shapes:
    """Points on the collision geoms of everything in a scene; computed once, shared by the experts of a task."""

    def __init__(self, scene: Scene):
        self._scene = scene
        self._bodies: dict[tuple[int, float], np.ndarray] = {}

    @cached_property
    def arm(self) -> Arm:
        """What the arm can reach."""
        return Arm(self._scene.model)

    @cached_property
    def fine(self) -> dict[str, np.ndarray]:
        """Name -> (N, 3) in the object's frame, m; dense enough to measure widths."""
        model = self._scene.model
        return {n: surface_points(model, model.body(f"{n}_main").id, FINE) for n in self._scene.objects}

    def cloud(self, view: StateView, name: str) -> np.ndarray:
        """Points on an object, world frame, (N, 3)."""
        return pose_of(view, name).apply(self.fine[name])

    def span(self, view: StateView, name: str) -> tuple[float, float]:
        """Lowest and highest point of an object or fixture, m."""
        heights = self.points(view, name, COARSE)[:, 2]
        return float(heights.min()), float(heights.max())

    def others(self, view: StateView, *names: str, spacing: float = COARSE) -> np.ndarray:
        """Points on all objects and fixtures but these, world frame, (M, 3)."""
        clouds = [self.points(view, name, spacing) for name in self._scene.entities if name not in names]
        return np.concatenate([*clouds, np.zeros((0, 3))])

    def points(self, view: StateView, name: str, spacing: float) -> np.ndarray:
        """Points on an object or fixture as its parts are now, world frame, (N, 3)."""
        pos, quat = (view.simulations.fields[key][view.index] for key in ("xpos", "xquat"))
        clouds = []
        for body in self._scene.bodies[name]:
            local = self._body(int(body), spacing)
            if len(local):
                clouds.append(Pose(pos[body], quat_to_mat(quat[body])).apply(local))
        return np.concatenate([*clouds, np.zeros((0, 3))])

    def _body(self, body: int, spacing: float) -> np.ndarray:
        if (body, spacing) not in self._bodies:
            self._bodies[body, spacing] = body_points(self._scene.model, body, spacing)
        return self._bodies[body, spacing]


def pose_of(view: StateView, name: str) -> Pose:
    """Pose of the root body of an object or fixture."""
    return Pose(view.body_pos(name), quat_to_mat(view.body_quat(name)))
