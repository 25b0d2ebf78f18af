"""Observations of the original's environments under robosuite's names; quaternions xyzw, pictures lowest row first."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mujoco
import numpy as np

from libero._adapters.envs.sim import MjSim
from libero_env.assets.robot import GRIP_SITE
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.geometry import quat_to_mat

SEGMENTATIONS = ("instance", "class", "element")


@dataclass(frozen=True)
class Camera:
    """One camera of the observations: its size in pixels, and the kinds of picture besides colour."""

    name: str
    height: int
    width: int
    depth: bool = False
    segmentations: tuple[str, ...] = ()


def cameras(names: Any, heights: Any, widths: Any, depths: Any, segmentations: Any) -> tuple[Camera, ...]:
    """Return the cameras of robosuite's arguments, where one value stands for all cameras.

    Raises:
        LiberoError: The lists have different lengths.
        UnknownNameError: The segmentation does not exist.
    """
    names = [names] if isinstance(names, str) else list(names)
    sequence = (list, tuple)
    nested = isinstance(segmentations, sequence) and any(isinstance(s, sequence) for s in segmentations)
    kinds = list(segmentations) if nested else [segmentations] * len(names)
    columns = [_each(heights, len(names)), _each(widths, len(names)), _each(depths, len(names)), kinds]
    if any(len(column) != len(names) for column in columns):
        raise LiberoError(
            f"expected one value or {len(names)} in camera_heights, _widths, _depths, _segmentations"
        )
    return tuple(
        Camera(name, h, w, bool(depth), _kinds(kind))
        for name, h, w, depth, kind in zip(names, *columns, strict=True)
    )


def _each(value: object, count: int) -> list:
    return list(value) if isinstance(value, list | tuple) else [value] * count


def _kinds(value: object) -> tuple[str, ...]:
    kinds = tuple(kind for kind in _each(value, 1) if kind is not None)
    for kind in kinds:
        if kind not in SEGMENTATIONS:
            raise UnknownNameError("segmentation", kind, SEGMENTATIONS)
    return kinds


@dataclass
class Observer:
    """Observes a simulation as the original does.

    Attributes:
        sim: Simulation to observe.
        objects: Names of the movable objects.
        cameras: Cameras that are drawn for each observation.
        segments: Kind of segmentation -> number of each geom, (ngeom + 1,); the last entry is the background.
    """

    sim: MjSim
    objects: Sequence[str]
    cameras: Sequence[Camera] = ()
    segments: dict[str, np.ndarray] = field(default_factory=dict)

    def observe(self) -> "OrderedDict[str, np.ndarray]":
        """Return all observations of the state whose kinematics are computed."""
        robot, pictures, objects = self._robot(), self._pictures(), self._objects()
        found = OrderedDict({**robot, **pictures, **objects})
        found["robot0_proprio-state"] = np.concatenate(list(robot.values()))
        if objects:
            found["object-state"] = np.concatenate(list(objects.values()))
        return found

    def groups(self) -> dict[str, list[str]]:
        """Return the names of the observations, without the concatenated ones, by robosuite's modality."""
        images = [
            f"{camera.name}_{kind}"
            for camera in self.cameras
            for kind in (
                "image",
                *["depth"] * camera.depth,
                *(f"segmentation_{k}" for k in camera.segmentations),
            )
        ]
        return {"robot0_proprio": list(self._robot()), "image": images, "object": list(self._objects())}

    def _robot(self) -> dict[str, np.ndarray]:
        data = self.sim.data
        joints = data.qpos[:7].copy()
        pos, quat = self._grip()
        return {
            "robot0_joint_pos": joints,
            "robot0_joint_pos_cos": np.cos(joints),
            "robot0_joint_pos_sin": np.sin(joints),
            "robot0_joint_vel": data.qvel[:7].copy(),
            "robot0_eef_pos": pos.copy(),
            "robot0_eef_quat": np.roll(quat, -1),
            "robot0_gripper_qpos": data.qpos[7:9].copy(),
            "robot0_gripper_qvel": data.qvel[7:9].copy(),
        }

    def _grip(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the grip site and the orientation of the hand, wxyz."""
        return self.sim.data.get_site_xpos(GRIP_SITE), self.sim.data.get_body_xquat("robot0_right_hand")

    def _objects(self) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        grip_pos, grip_quat = self._grip()
        inverse = np.empty(4)
        mujoco.mju_negQuat(inverse, grip_quat)
        rotation = quat_to_mat(inverse)
        for name in self.objects:
            pos = self.sim.data.get_body_xpos(f"{name}_main")
            quat = self.sim.data.get_body_xquat(f"{name}_main")
            relative = np.empty(4)
            mujoco.mju_mulQuat(relative, inverse, quat)
            found[f"{name}_pos"], found[f"{name}_quat"] = pos.copy(), np.roll(quat, -1)
            found[f"{name}_to_robot0_eef_pos"] = rotation @ (pos - grip_pos)
            found[f"{name}_to_robot0_eef_quat"] = np.roll(relative if relative[0] >= 0 else -relative, -1)
        return found

    def _pictures(self) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        for camera in self.cameras:
            render = partial(self.sim.render, camera.width, camera.height, camera_name=camera.name)
            if camera.depth:
                image, depth = render(depth=True)
                found[f"{camera.name}_image"], found[f"{camera.name}_depth"] = image, depth[..., None]
            else:
                found[f"{camera.name}_image"] = render()
            if camera.segmentations:
                for kind in camera.segmentations:
                    element = kind == "element"
                    numbers = render(segmentation=True, hidden_sites=element)[..., 1:]
                    # the background, -1, is the last entry
                    numbers = numbers if element else self.segments[kind][numbers]
                    found[f"{camera.name}_segmentation_{kind}"] = numbers.astype(np.int32)
        return {key: np.ascontiguousarray(value) for key, value in found.items()}
