"""Classes of objects by category, as the original registers them, with the models of `libero_env`."""

import re
from collections import UserDict
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from functools import cached_property, partialmethod
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from libero._adapters.lookup import Named, lookup
from libero._adapters.models import STATES, accept_plain_files, assets_folder, facade_pack, model_of
from libero._adapters.sim import MjSim
from libero_env.objects import ObjectModel, get_object
from libero_env.objects import register_object as register_model
from libero_env.objects.builtin import builtin_names
from libero_env.objects.builtin.physics import Physics, load_physics
from libero_env.sim.predicates import reaches_state


class _Objects(UserDict):
    """Classes, or functions of a name, by category; scenes are built from those of users."""

    def __setitem__(self, category: str, made_by: Any) -> None:
        super().__setitem__(category, made_by)
        if not _is_benchmarks(category, made_by):
            register_model(category, lambda: model_of(made_by(name=category), category))


def _is_benchmarks(category: str, made_by: Any) -> bool:
    """Return whether a category of the benchmark keeps its model: its class, or a user's without a file of its own."""
    if not (isinstance(made_by, type) and issubclass(made_by, BuiltinObject) and category in builtin_names()):
        return False
    if made_by.__init__ is BuiltinObject.__init__ or not made_by.family:
        return category_of(made_by.__name__) == category
    item = made_by(name=category)
    return not hasattr(item, "file") and item.model_category == category


OBJECTS_DICT: MutableMapping[str, Any] = _Objects()
VISUAL_CHANGE_OBJECTS_DICT: dict[str, Any] = {}


def category_of(name: str) -> str:
    """Return the category of a class name: `chefmate_8_frypan` for `Chefmate8Frypan`."""
    return "_".join(re.sub(r"([A-Z0-9])", r" \1", name).split()).lower()


def class_name(category: str) -> str:
    """Return the class name of a category, the inverse of `category_of`."""
    return "".join(map(str.title, category.split("_")))


def register_object(target_class: Any) -> Any:
    """Register a class by its name, and its MJCF file, if it has one, for the scenes that are built from now on."""
    category = category_of(target_class.__name__)
    if hasattr(target_class, "_get_object_subtree") and hasattr(target_class, "save_model"):  # of a file
        accept_plain_files(target_class)
    OBJECTS_DICT[category] = target_class
    return target_class


def register_visual_change_object(target_class: type) -> type:
    """Register a class whose objects look different in some states."""
    VISUAL_CHANGE_OBJECTS_DICT[category_of(target_class.__name__)] = target_class
    return target_class


def get_object_fn(category_name: str) -> type:
    """Return the class of a category, ignoring case; raise an UnknownNameError if there is none."""
    return lookup(OBJECTS_DICT, "object category", category_name)


def get_object_dict() -> MutableMapping[str, Any]:
    """Return all classes by category."""
    return OBJECTS_DICT


def _joints(item: "BaseObject") -> list[str]:
    """Return the names of its joints; the free joint, if any, is the first."""
    joints = [name for name in item._names(item.model.spec.joints) if name != f"{item.name}_joint0"]
    return joints if item._fixed else [f"{item.name}_joint0", *joints]


_NAMES: dict[str, Callable[[Any], Any]] = {  # lengths in m, quaternions wxyz
    "naming_prefix": lambda item: f"{item.name}_",
    "root_body": lambda item: f"{item.name}_main",
    "bodies": lambda item: item._names(item.model.spec.bodies[1:]),
    "joints": _joints,
    "sites": lambda item: item._names(item.model.spec.sites),
    "actuators": lambda item: item._names(item.model.spec.actuators),
    "sensors": lambda item: item._names(item.model.spec.sensors),
    "contact_geoms": lambda item: item._names(g for g in item.model.spec.geoms if g.contype or g.conaffinity),
    "visual_geoms": lambda item: item._names(g for g in item.model.spec.geoms if g.group == 1),
    "important_sites": lambda item: {"obj": f"{item.name}_default_site"},
    "important_geoms": lambda item: {},
    "important_sensors": lambda item: {},
    "bottom_offset": lambda item: np.array(item.model.bottom_offset),
    "top_offset": lambda item: np.array(item.model.top_offset),
    "horizontal_radius": lambda item: np.float64(item.model.horizontal_radius),
    "init_quat": lambda item: item.model.rest_quat(),
}


class BaseObject(Named, names=_NAMES):
    """An instance of a category in a scene: names of its elements, rotation at rest, and joint ranges.

    `is_open`, `is_close`, `turn_on` and `turn_off` tell whether a joint position is in the range of that state.

    Attributes:
        name: Name of the instance, such as `milk_1`.
        category_name: Category, such as `milk`.
        rotation: Range (low, high) about `rotation_axis`, rad; or axis -> (low, high); or None.
        object_properties: `articulation` (`default_open_ranges`, ...) and `vis_site_names`.
        bottom_offset, top_offset: Lowest and highest point relative to the root body, (3,) m.
    """

    name: str
    category_name: str
    rotation: Any = None
    rotation_axis: str | None = None
    object_properties: dict[str, Any]

    @cached_property
    def model(self) -> ObjectModel:
        """Model that scenes attach."""
        raise NotImplementedError

    horizontal_radius: Any
    _fixed = False

    def set_sites_visibility(self, sim: MjSim, visible: bool) -> None:
        """Show or hide its sites."""
        sim.show_sites(self.sites, visible)

    def get_xml(self) -> str:
        """Return the object as MJCF."""
        return self.model.spec.to_xml()

    def _names(self, elements: Any) -> list[str]:
        # a model that is part of a scene has the prefix already
        return [f"{self.name}_{element.name.removeprefix(self.naming_prefix)}" for element in elements]


def _reaches(item: BaseObject, qpos: float, *, state: str) -> bool:
    return bool(reaches_state(item.model, qpos, state))


for _name, _state in (
    ("is_open", "open"),
    ("is_close", "close"),
    ("turn_on", "turnon"),
    ("turn_off", "turnoff"),
):
    setattr(BaseObject, _name, partialmethod(_reaches, state=_state))


class BuiltinObject(BaseObject):
    """A category of the benchmark, with the model of the pack in use; or a user-defined category with an MJCF file.

    Args:
        name: Name of the instance; by default the category.
        obj_name: Category of the benchmark whose model it has, by default that of the nearest class; or the path of a
            file, or its stem in the folder of the family.
        joints: Joints, see `MujocoXMLObject`.
        model: Model that a scene has built.
    """

    family = ""  # folder of the family in the assets
    in_folders = True  # whether each object of the family has a folder of its own

    def __init__(
        self,
        name: str | None = None,
        obj_name: str | None = None,
        joints: Any = "default",
        model: ObjectModel | None = None,
        **_: Any,
    ):
        self.category_name = category_of(type(self).__name__)
        self.name, self._fixed = name or self.category_name, joints is None
        if model is not None:
            self.__dict__["model"] = model
        names = [obj_name] if obj_name else [category_of(cls.__name__) for cls in type(self).__mro__]
        known = next((name for name in names if name in builtin_names()), None)
        self.model_category = known or self.category_name
        if self.family and known is None:
            self._own_file(obj_name or self.category_name, joints)
            return
        physics = model or _parameters(self.model_category)
        self.rotation = dict(physics.rotation) or None
        self.rotation_axis = physics.rotation_axis
        if self.rotation and self.rotation_axis in self.rotation and len(self.rotation) == 1:
            self.rotation = self.rotation[self.rotation_axis]
        self.object_properties = _properties(physics.articulation)

    def _own_file(self, obj_name: str, joints: Any) -> None:
        folder = (assets_folder() or Path("assets")) / self.family
        stem = Path(obj_name)
        if stem.suffix != ".xml":
            stem = folder / (stem if self.in_folders else "") / f"{stem.name}.xml"
        self.file, self.joint_specs = str(stem), joints
        self.object_properties = _properties({})

    @cached_property
    def model(self) -> ObjectModel:
        """Model in the pack in use."""
        return facade_pack().build(self.model_category)


def _properties(articulation: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    ranges = {f"default_{state}_ranges": list(articulation.get(state, ())) for state in STATES}
    return {"articulation": ranges, "vis_site_names": {}}


def _parameters(category: str) -> ObjectModel | Physics:
    """Return rotation and joint ranges of a category, if possible without building its model."""
    try:
        return load_physics(category)
    except KeyError:
        return get_object(category)


class MujocoXMLObject(BaseObject):
    """An object from an MJCF file, with the interface of robosuite's class of that name.

    Args:
        fname: MJCF file, see `libero._adapters.models`; `custom_path` is another name for it.
        name: Name of the instance.
        joints: Joints, `[{"type": "free", "damping": "0.0005"}]`; None for an object that does not move.
        obj_type: Accepted without effect.
        duplicate_collision_geoms: Whether collision geoms are visible, too.

    Raises:
        TypeError: No file is given.
    """

    def __init__(
        self,
        fname: str | PathLike = "",
        name: str = "",
        joints: Any = "default",
        obj_type: str = "all",
        duplicate_collision_geoms: bool = True,
        *,
        custom_path: str | PathLike = "",
    ):
        if not (fname or custom_path):
            raise TypeError(f"{type(self).__name__}: no MJCF file; pass its path as fname")
        self.file, self.name, self.joint_specs = str(fname or custom_path), name, joints
        self.duplicate_collision_geoms = duplicate_collision_geoms
        self.category_name = category_of(type(self).__name__)
        self.object_properties = {"vis_site_names": {}}
        self._fixed = joints is None

    @cached_property
    def model(self) -> ObjectModel:
        """Model of the file."""
        return model_of(self, self.category_name)


def declare(base: type[BaseObject], categories: Iterable[str]) -> dict[str, type]:
    """Register a subclass of `base` for each of the categories, and return them by name."""
    facts = {"__module__": base.__module__}
    classes = [type(class_name(c), (base,), {**facts, "__doc__": f"`{c}`"}) for c in categories]
    return {cls.__name__: register_object(cls) for cls in classes}
