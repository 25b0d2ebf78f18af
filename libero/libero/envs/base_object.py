"""Classes of objects by category, as the original registers them, over the models of `libero_env`."""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from libero_env.assets import select_pack
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects import ObjectModel, get_object
from libero_env.objects import register_object as register_model
from libero_env.objects.builtin.facts import Facts, load_facts
from libero_env.original_mjcf import object_xml

OBJECTS_DICT: dict[str, Any] = {}
VISUAL_CHANGE_OBJECTS_DICT: dict[str, Any] = {}
_STATES = ("open", "close", "turnon", "turnoff")


def category_of(name: str) -> str:
    """Category that a class name stands for: `Chefmate8Frypan` is `chefmate_8_frypan`."""
    return "_".join(re.sub(r"([A-Z0-9])", r" \1", name).split()).lower()


def register_object(target_class: Any) -> Any:
    """Make a class known by its name; a class with an MJCF file of its own also to the scenes built from now on."""
    category = category_of(target_class.__name__)
    OBJECTS_DICT[category] = target_class
    if not issubclass(target_class, BuiltinObject):
        register_model(category, lambda: model_of(target_class(name=category), category))
    return target_class


def register_visual_change_object(target_class: type) -> type:
    """Say that objects of a class look different in some states."""
    VISUAL_CHANGE_OBJECTS_DICT[category_of(target_class.__name__)] = target_class
    return target_class


def get_object_fn(category_name: str) -> type:
    """The class of a category; case does not count.

    Raises:
        UnknownNameError: no class has this name.
    """
    if category_name.lower() not in OBJECTS_DICT:
        raise UnknownNameError("object category", category_name, OBJECTS_DICT)
    return OBJECTS_DICT[category_name.lower()]


def get_object_dict() -> dict[str, type]:
    """All classes."""
    return OBJECTS_DICT


class BaseObject:
    """An instance of a category in a scene: names of its elements, how it rests, what counts as open.

    Attributes:
        name: of the instance, such as `milk_1`.
        category_name: such as `milk`.
        rotation: (low, high) rad about `rotation_axis`, or axis -> (low, high), or None.
        object_properties: `articulation` (`default_open_ranges`, ...) and `vis_site_names`.
    """

    name: str
    category_name: str
    rotation: Any = None
    rotation_axis: str | None = None
    object_properties: dict[str, Any]

    @cached_property
    def model(self) -> ObjectModel:
        """What scenes attach."""
        raise NotImplementedError

    @property
    def naming_prefix(self) -> str:
        """What the names of its elements begin with."""
        return f"{self.name}_"

    @property
    def root_body(self) -> str:
        """Name of its root body."""
        return f"{self.name}_main"

    @property
    def bodies(self) -> list[str]:
        """Names of its bodies."""
        return self._names(self.model.spec.bodies[1:])

    @property
    def joints(self) -> list[str]:
        """Names of its joints, the free one first where it has one."""
        own = [name for name in self._names(self.model.spec.joints) if name != f"{self.name}_joint0"]
        return own if self._fixed else [f"{self.name}_joint0", *own]

    @property
    def sites(self) -> list[str]:
        """Names of its sites."""
        return self._names(self.model.spec.sites)

    @property
    def important_sites(self) -> dict[str, str]:
        """Site -> its name in the scene."""
        return {name.removeprefix(self.naming_prefix): name for name in self.sites}

    @property
    def contact_geoms(self) -> list[str]:
        """Names of the geoms that things touch."""
        return self._names(g for g in self.model.spec.geoms if g.contype or g.conaffinity)

    @property
    def visual_geoms(self) -> list[str]:
        """Names of the geoms that are seen."""
        return self._names(g for g in self.model.spec.geoms if g.group == 1)

    @property
    def bottom_offset(self) -> np.ndarray:
        """Lowest point relative to the root, (3,) m."""
        return np.array(self.model.bottom_offset)

    @property
    def top_offset(self) -> np.ndarray:
        """Highest point relative to the root, (3,) m."""
        return np.array(self.model.top_offset)

    @property
    def horizontal_radius(self) -> float:
        """Radius that placement keeps free, m."""
        return self.model.horizontal_radius

    @property
    def init_quat(self) -> np.ndarray:
        """Orientation at rest, wxyz (4,)."""
        return self.model.rest_quat()

    def get_xml(self) -> str:
        """The object as MJCF."""
        return self.model.spec.to_xml()

    def is_open(self, qpos: float) -> bool:
        """Whether a joint position counts as open."""
        return self._reached(qpos, "open", "close")

    def is_close(self, qpos: float) -> bool:
        """Whether a joint position counts as closed."""
        return self._reached(qpos, "close", "open")

    def turn_on(self, qpos: float) -> bool:
        """Whether a joint position counts as on."""
        return self._reached(qpos, "turnon", "turnoff")

    def turn_off(self, qpos: float) -> bool:
        """Whether a joint position counts as off."""
        return self._reached(qpos, "turnoff", "turnon")

    _fixed = False

    def _names(self, elements: Any) -> list[str]:
        return [f"{self.name}_{element.name}" for element in elements]

    def _reached(self, qpos: float, state: str, opposite: str) -> bool:
        ranges = self.model.articulation
        if state not in ranges:
            raise LiberoError(
                f"{self.category_name}: nothing says when it is {state!r}; it has {', '.join(ranges)}"
            )
        low, high = sorted(ranges[state])
        upwards = opposite not in ranges or low + high > sum(ranges[opposite])
        if state == "turnon":
            return qpos >= low if upwards else qpos <= high
        return qpos > low if upwards else qpos < high


class BuiltinObject(BaseObject):
    """A category of the benchmark; its model comes from the pack in use."""

    def __init__(
        self, name: str | None = None, obj_name: str | None = None, model: ObjectModel | None = None, **_: Any
    ):
        self.category_name = category_of(type(self).__name__)
        self.name = name or self.category_name
        facts = model or _figures(self.category_name)
        self.rotation = dict(facts.rotation) or None
        self.rotation_axis = facts.rotation_axis
        if self.rotation and self.rotation_axis in self.rotation and len(self.rotation) == 1:
            self.rotation = self.rotation[self.rotation_axis]
        articulation = {
            f"default_{state}_ranges": list(facts.articulation.get(state, ())) for state in _STATES
        }
        self.object_properties = {"articulation": articulation, "vis_site_names": {}}
        if model is not None:
            self.__dict__["model"] = model

    @cached_property
    def model(self) -> ObjectModel:
        """Its model in the pack in use."""
        return select_pack().build(self.category_name)


def _figures(category: str) -> ObjectModel | Facts:
    """How a category rests and moves; without building its model where figures are kept apart."""
    try:
        return load_facts(category)
    except KeyError:
        return get_object(category)


class MujocoXMLObject(BaseObject):
    """An object from an MJCF file, with the interface of robosuite's class of that name.

    Args:
        fname: MJCF file: below an outer body, with its offset sites, the body `object`.
        name: of the instance.
        joints: `[{"type": "free", "damping": "0.0005"}]`, or None for one that does not move.
        obj_type, duplicate_collision_geoms: accepted, of no effect.
    """

    def __init__(
        self,
        fname: str,
        name: str,
        joints: Any = "default",
        obj_type: str = "all",
        duplicate_collision_geoms: bool = True,
    ):
        self.file, self.name, self.joint_specs = str(fname), name, joints
        self.category_name = category_of(type(self).__name__)
        self.object_properties = {"vis_site_names": {}}
        self._fixed = joints is None

    @cached_property
    def model(self) -> ObjectModel:
        """The file's model."""
        return model_of(self, self.category_name)


def model_of(item: Any, category: str) -> ObjectModel:
    """The model of an object that has an MJCF file: ours, or one of a subclass of robosuite's class.

    Raises:
        LiberoError: the file is missing or not laid out as expected.
    """
    path = Path(item.file)
    spec = mujoco.MjSpec.from_string(object_xml(path, category))
    sites = {
        s.get("name"): s.get("pos", "0 0 0") for s in ElementTree.parse(path).iterfind("worldbody/body/site")
    }
    place: dict[str, Any] = {
        name: tuple(map(float, sites.get(f"{name}_site", "0 0 0").split())) for name in _OFFSETS
    }
    joints = [joint for joint in _listed(getattr(item, "joint_specs", None)) if joint.get("type") == "free"]
    rotation = getattr(item, "rotation", None)
    if rotation is not None and not isinstance(rotation, Mapping):
        rotation = {getattr(item, "rotation_axis", None) or "z": rotation}
    given = getattr(item, "object_properties", {}).get("articulation", {})
    articulation = {state: given.get(f"default_{state}_ranges") for state in _STATES}
    return ObjectModel(
        category=category,
        spec=spec,
        joint_damping=float(joints[0].get("damping", 0.0005)) if joints else 0.0005,
        rotation={axis: (float(low), float(high)) for axis, (low, high) in (rotation or {}).items()},
        rotation_axis=getattr(item, "rotation_axis", None),
        bottom_offset=place["bottom"],
        top_offset=place["top"],
        horizontal_radius=max(map(abs, place["horizontal_radius"][:2])),
        articulation={state: (float(r[0]), float(r[1])) for state, r in articulation.items() if r},
    )


_OFFSETS = ("bottom", "top", "horizontal_radius")


def _listed(joints: Any) -> list[dict[str, str]]:
    return [{"type": "free"}] if joints == "default" else [j for j in joints or () if isinstance(j, dict)]


def declare(base: type[BaseObject], module: str, names: str) -> list[type]:
    """Subclasses of `base` for these class names, registered, in order."""
    return [register_object(type(name, (base,), {"__module__": module, "__doc__": f"`{category_of(name)}`"}))
            for name in names.split()]  # fmt: skip
