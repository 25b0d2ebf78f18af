"""Observations and contacts of the original's environments, with robosuite's names and observables.

Quaternions are xyzw, pictures have the lowest row first.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial, partialmethod
from typing import Any

import numpy as np

from libero._adapters.lookup import Named, lookup
from libero._adapters.sim import MjSim
from libero_env.assets.robot import GRIP_SITE
from libero_env.errors import LiberoError, require_known
from libero_env.geometry import mat_to_quat, quat_to_mat
from libero_env.mujoco_compat import mujoco

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
        require_known("segmentation", kind, SEGMENTATIONS)
    return kinds


def quat_xyzw(mat: np.ndarray) -> np.ndarray:
    """Return a rotation matrix, (3, 3), as robosuite's quaternion xyzw, (4,) float32, whose w is not negative."""
    quat = mat_to_quat(mat)
    return np.roll(quat if quat[0] >= 0 else -quat, -1).astype(np.float32)


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
        values = OrderedDict({**robot, **pictures, **objects})
        values["robot0_proprio-state"] = np.concatenate(list(robot.values()))
        if objects:
            values["object-state"] = np.concatenate(list(objects.values()))
        return values

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
        values: dict[str, np.ndarray] = {}
        grip_pos, grip_quat = self._grip()
        inverse = np.empty(4)
        mujoco.mju_negQuat(inverse, grip_quat)
        rotation = quat_to_mat(inverse)
        for name in self.objects:
            pos = self.sim.data.get_body_xpos(f"{name}_main")
            quat = self.sim.data.get_body_xquat(f"{name}_main")
            relative = np.empty(4)
            mujoco.mju_mulQuat(relative, inverse, quat)
            values[f"{name}_pos"], values[f"{name}_quat"] = pos.copy(), np.roll(quat, -1)
            values[f"{name}_to_robot0_eef_pos"] = rotation @ (pos - grip_pos)
            relative = np.roll(relative if relative[0] >= 0 else -relative, -1)
            values[f"{name}_to_robot0_eef_quat"] = relative.astype(np.float32)
        return values

    def _pictures(self) -> dict[str, np.ndarray]:
        values: dict[str, np.ndarray] = {}
        for camera in self.cameras:
            render = partial(self.sim.render, camera.width, camera.height, camera_name=camera.name)
            if camera.depth:
                image, depth = render(depth=True)
                values[f"{camera.name}_image"], values[f"{camera.name}_depth"] = image, depth[..., None]
            else:
                values[f"{camera.name}_image"] = render()
            for kind in camera.segmentations:
                numbers = render(segmentation=True)[..., 1:]
                if kind != "element":
                    numbers = self.segments[kind][numbers]  # the background, -1, is the last entry
                values[f"{camera.name}_segmentation_{kind}"] = numbers.astype(np.int32)
        return {key: np.ascontiguousarray(value) for key, value in values.items()}


_SETTERS = ("sensor", "corrupter", "filter", "enabled", "active")


class Observable:
    """One observation, with the interface of robosuite's class, whose instances are accepted beside it.

    Args:
        sensor: Function of the observations made before it, by name, that returns the value; None for the value that
            the environment has for this name.
        corrupter: Function of the value, such as noise.
        filter: Function of the corrupted value.
        enabled: Whether it is measured.
        active: Whether it is among the observations; others may use it in any case.
        modality: Group of the observations that `<modality>-state` concatenates.
    """

    def __init__(
        self,
        name: str,
        sensor: Callable[[Mapping[str, Any]], Any] | None = None,
        corrupter: Callable[[Any], Any] | None = None,
        filter: Callable[[Any], Any] | None = None,
        enabled: bool = True,
        active: bool = True,
        modality: str = "",
    ):
        self.name = name
        self.obs: Any = None
        self.modality = modality or getattr(sensor, "__modality__", "")
        self._settings: dict[str, Any] = {"sensor": sensor, "corrupter": corrupter, "filter": filter}
        self._settings |= {"enabled": enabled, "active": active}

    @property
    def is_plain(self) -> bool:
        """Whether it is the environment's own observation, unchanged."""
        functions = [self._settings[key] for key in ("sensor", "corrupter", "filter")]
        return functions == [None] * 3 and self.is_enabled() and self.is_active()

    def is_enabled(self) -> bool:
        """Return whether it is measured."""
        return bool(self._settings["enabled"])

    def is_active(self) -> bool:
        """Return whether it is among the observations."""
        return bool(self._settings["active"])

    def set(self, attribute: str, value: Any) -> None:
        """Set one of the arguments."""
        self._settings[attribute] = value

    def update(self, timestep: float, obs_cache: dict[str, Any], force: bool = False) -> None:
        """Measure it, and write the value into the observations made so far."""
        sensor = self._settings["sensor"]
        value = obs_cache.get(self.name) if sensor is None else np.asarray(sensor(obs_cache))
        for function in filter(None, (self._settings["corrupter"], self._settings["filter"])):
            value = function(value)
        self.obs = obs_cache[self.name] = value

    def reset(self) -> None:
        """Do nothing: no value of the last episode is kept."""


for _setting in _SETTERS:
    setattr(Observable, f"set_{_setting}", partialmethod(Observable.set, _setting))


_SETS: dict[str, Callable[[Any], Any]] = {
    "observation_names": lambda env: set(env._observables),
    "enabled_observables": lambda env: {name for name, o in env._observables.items() if o.is_enabled()},
    "active_observables": lambda env: {name for name, o in env._observables.items() if o.is_active()},
    "observation_modalities": lambda env: {o.modality for o in env._observables.values()},
}


class RobosuiteMethods(Named, names=_SETS):
    """Contacts and observables of an environment with `sim`, `observer` and `control_freq`."""

    sim: MjSim
    observer: Observer
    control_freq: float
    _observables: "OrderedDict[str, Any]"

    # Contacts -----------------------------------------------------------------------------------------------

    def check_contact(self, geoms_1: Any, geoms_2: Any = None) -> bool:
        """Return whether a geom of the first group touches one of the second, or any other geom if that is None.

        A group is a name, names, or an object with `contact_geoms`.
        """
        first, second = _geoms(geoms_1), None if geoms_2 is None else _geoms(geoms_2)
        return any(a in first and (second is None or b in second) for a, b in self._contacts())

    def get_contacts(self, model: Any) -> set[str]:
        """Return the names of the geoms that touch an object, without its own."""
        geoms = _geoms(model)
        return {b for a, b in self._contacts() if a in geoms and b not in geoms}

    def _check_grasp(self, gripper: Any, object_geoms: Any) -> bool:
        """Return whether each finger pad of the gripper, or each given group of geoms, touches the object."""
        if hasattr(gripper, "important_geoms"):
            gripper = [gripper.important_geoms[f"{side}_fingerpad"] for side in ("left", "right")]
        groups = [gripper] if isinstance(gripper, str) else gripper
        return all(self.check_contact(group, object_geoms) for group in groups)

    def _gripper_to_target(
        self, gripper: Any, target: Any, target_type: str = "body", return_distance: bool = False
    ) -> Any:
        """Return the vector from the grip site to a target, (3,) m, or its length."""
        if hasattr(target, "root_body"):
            target, target_type = target.root_body, "body"
        read = getattr(self.sim.data, f"get_{target_type}_xpos")
        difference = read(target) - self.sim.data.get_site_xpos(gripper.important_sites["grip_site"])
        return float(np.linalg.norm(difference)) if return_distance else difference

    def _contacts(self) -> list[tuple[str, str]]:
        """Return the names of the geoms that touch, each pair in both orders."""
        name, data = self.sim.model.geom_id2name, self.sim.data
        pairs = [(name(c.geom1), name(c.geom2)) for c in data.contact[: data.ncon]]
        return pairs + [(b, a) for a, b in pairs]

    # Observables --------------------------------------------------------------------------------------------

    def _setup_observables(self) -> "OrderedDict[str, Any]":
        """Return the observables by name; a subclass may add some."""
        groups = self.observer.groups().items()
        return OrderedDict(
            (name, Observable(name, modality=group)) for group, names in groups for name in names
        )

    def add_observable(self, observable: Any) -> None:
        """Add an observable; raise a LiberoError if there is one of this name."""
        if observable.name in self._observables:
            raise LiberoError(f"there is an observable {observable.name!r}: change it with modify_observable")
        self._observables[observable.name] = observable

    def modify_observable(self, observable_name: str, attribute: str, modifier: Any) -> None:
        """Set `sensor`, `corrupter`, `filter`, `enabled` or `active` of an observable."""
        observable = lookup(self._observables, "observable", observable_name)
        lookup(dict.fromkeys(_SETTERS), "attribute of an observable", attribute)
        getattr(observable, f"set_{attribute}")(modifier)

    def _observe(self) -> "OrderedDict[str, np.ndarray]":
        """Return the observations of the present state, as the observables have them."""
        values = self.observer.observe()
        if all(isinstance(o, Observable) and o.is_plain for o in self._observables.values()):
            for name, observable in self._observables.items():
                observable.obs = values[name]
            return values
        cache: dict[str, Any] = {name: value for name, value in values.items() if name in self._observables}
        active: OrderedDict[str, np.ndarray] = OrderedDict()
        groups: dict[str, list[np.ndarray]] = {}
        for name, observable in self._observables.items():
            if not observable.is_enabled():
                cache.pop(name, None)
                continue
            observable.update(timestep=1.0 / self.control_freq, obs_cache=cache, force=True)
            if observable.is_active():
                active[name] = observable.obs
                if observable.modality and np.ndim(observable.obs) <= 1:
                    groups.setdefault(observable.modality, []).append(np.atleast_1d(observable.obs))
        return OrderedDict(
            active | {f"{group}-state": np.concatenate(rows) for group, rows in groups.items()}
        )


def _geoms(group: Any) -> Sequence[str] | Iterable[str]:
    """Return the names of a group of geoms: a name, names, or an object with `contact_geoms`."""
    return [group] if isinstance(group, str) else getattr(group, "contact_geoms", group)
