"""Scenes as classes: what stands there, and where. Tasks are defined on them with `task_generation_utils`."""

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from libero.libero.utils.bddl_generation_utils import (
    WORKSPACE_CATEGORIES,
    get_affordance_region_kwargs_list_from_fixture_info,
    get_object_dict,
    get_xy_region_kwargs_list_from_regions_info,
)
from libero_env.errors import LiberoError, UnknownNameError

MU_DICT: dict[str, Any] = {}  # classes that are made without arguments
SCENE_DICT: dict[str, list[type["InitialSceneTemplates"]]] = {"kitchen": [], "living_room": [], "study": []}

Template = TypeVar("Template", bound=type["InitialSceneTemplates"])


def scene_key(name: str) -> str:
    """What a scene is registered as: `KitchenScene1` and `KITCHEN_SCENE1` are `kitchen_scene1`."""
    if not name.isupper():
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return name.lower()


def register_mu(scene_type: str) -> Callable[[Template], Template]:
    """Class decorator: make a scene known by its name; a later one of the same name takes its place.

    Args:
        scene_type: such as `kitchen`; any name.
    """

    def register(target_class: Template) -> Template:
        key = scene_key(target_class.__name__)
        for scenes in SCENE_DICT.values():
            scenes[:] = [scene for scene in scenes if scene_key(scene.__name__) != key]
        MU_DICT[key] = target_class
        SCENE_DICT.setdefault(scene_type.lower(), []).append(target_class)
        return target_class

    return register


def get_scene_dict(scene_type: str | None = None) -> Any:
    """Scene type -> classes; or the classes of one type.

    Raises:
        UnknownNameError: no scene is of this type.
    """
    if scene_type is None:
        return SCENE_DICT
    if scene_type.lower() not in SCENE_DICT:
        raise UnknownNameError("scene type", scene_type, SCENE_DICT)
    return SCENE_DICT[scene_type.lower()]


def get_scene_class(scene_name: str) -> Callable[[], "InitialSceneTemplates"]:
    """A scene by the name of its class in any spelling; those of the benchmark are there without being imported.

    Raises:
        UnknownNameError: no such scene.
    """
    key = scene_key(scene_name)
    if key not in MU_DICT:
        importlib.import_module("libero.libero.benchmark.mu_creation")
    if key not in MU_DICT:
        raise UnknownNameError("scene", scene_name, MU_DICT)
    return MU_DICT[key]


class InitialSceneTemplates:
    """What stands in a scene, and where it may stand at the start, which subclasses say.

    Attributes:
        workspace_name: such as `kitchen_table`.
        fixture_object_dict, movable_object_dict: category -> names; `plate` is `plate_1`.
        regions: name -> facts, as `get_region_dict` gives them; filled by `define_regions`.
        xy_region_kwargs_list: rectangles on the workspace, from `regions` unless `define_regions` sets it.
        affordance_region_kwargs_list: places that belong to things, such as drawers.

    Args:
        workspace_name: the table, or `floor`.
        fixture_num_info: category -> number, of what does not move; the workspace may be among them.
        object_num_info: category -> number, of what can be moved; the order is that of their joints.

    Raises:
        UnknownNameError: no such workspace or category.
    """

    def __init__(
        self, workspace_name: str, fixture_num_info: Mapping[str, int], object_num_info: Mapping[str, int]
    ):
        if workspace_name not in WORKSPACE_CATEGORIES:
            raise UnknownNameError("workspace", workspace_name, WORKSPACE_CATEGORIES)
        self.workspace_name = workspace_name
        self.fixture_num_info = dict(fixture_num_info)
        if workspace_name not in self.fixture_num_info:
            self.fixture_num_info = {workspace_name: 1, **fixture_num_info}
        self.object_num_info = dict(object_num_info)
        self.fixture_object_dict = get_object_dict(self.fixture_num_info)
        self.movable_object_dict = get_object_dict(self.object_num_info)
        self.affordance_region_kwargs_list = get_affordance_region_kwargs_list_from_fixture_info(
            {**self.fixture_num_info, **self.object_num_info}
        )
        self.regions: dict[str, dict[str, Any]] = {}
        self.xy_region_kwargs_list: list[dict[str, Any]] = []
        self.define_regions()
        if not self.xy_region_kwargs_list:
            self.xy_region_kwargs_list = get_xy_region_kwargs_list_from_regions_info(self.regions)

    def define_regions(self) -> None:
        """Fill `regions`."""
        raise NotImplementedError(f"{type(self).__name__} must say where things stand: define_regions")

    @property
    def init_states(self) -> Sequence[Sequence[str]]:
        """Conditions of the start: `("On", "plate_1", "kitchen_table_plate_init_region")`."""
        raise NotImplementedError(f"{type(self).__name__} must say what holds at the start: init_states")

    def get_region_dict(
        self,
        region_centroid_xy: Sequence[float],
        region_name: str,
        target_name: str,
        region_half_len: float | Sequence[float] = 0.02,
        yaw_rotation: Sequence[float] = (0.0, 0.0),
    ) -> dict[str, dict[str, Any]]:
        """Name -> facts of a rectangle, for `regions.update`; arguments as in `bddl_generation_utils.get_xy_region`.

        Raises:
            LiberoError: the region is there already.
        """
        if region_name in self.regions:
            raise LiberoError(
                f"{type(self).__name__}: region {region_name} is defined twice; rename one of them"
            )
        facts = {
            "target_name": target_name,
            "region_centroid_xy": region_centroid_xy,
            "region_half_len": region_half_len,
            "yaw_rotation": yaw_rotation,
        }
        return {region_name: facts}

    @property
    def movable_objects(self) -> list[str]:
        """Names of the objects."""
        return list(self.movable_object_dict.names)

    @property
    def fixtures(self) -> list[str]:
        """Names of the fixtures, without the workspace."""
        return [name for name in self.fixture_object_dict.names if name != self.workspace_name]

    @property
    def possible_objects_of_interest(self) -> list[str]:
        """Everything that a task may be about: objects, fixtures, and the places that belong to them."""
        places = [f"{k['target_name']}_{k['region_name']}" for k in self.affordance_region_kwargs_list]
        return [*self.movable_objects, *self.fixtures, *places]
