"""Scenes as classes: which objects a scene has, and where they are at the start.

Tasks on them are defined with `task_generation_utils`. The scenes of LIBERO-100 are registered here; their content is
that of `libero_env.tasks`.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

from libero._adapters.lookup import lookup
from libero.libero.utils.bddl_generation_utils import (
    WORKSPACE_CATEGORIES,
    get_affordance_region_kwargs_list_from_fixture_info,
    get_object_dict,
    get_xy_region_kwargs_list_from_regions_info,
)
from libero_env.errors import LiberoError, require_known
from libero_env.tasks.builder import build_problem
from libero_env.tasks.merging import load_scene
from libero_env.tasks.problem import Problem

MU_DICT: dict[str, Any] = {}  # name -> class
SCENE_DICT: dict[str, list[type["InitialSceneTemplates"]]] = {"kitchen": [], "living_room": [], "study": []}

Counts = Mapping[str, int]
Template = TypeVar("Template", bound=type["InitialSceneTemplates"])


def scene_key(name: str) -> str:
    """Return the name that a scene is registered by: `KitchenScene1` and `KITCHEN_SCENE1` are `kitchen_scene1`."""
    if not name.isupper():
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return name.lower()


def register_mu(scene_type: str = "general") -> Callable[[Template], Template]:
    """Return a decorator that registers a scene of any type by its name; a scene of the same name is replaced."""

    def register(target_class: Template) -> Template:
        key = scene_key(target_class.__name__)
        for scenes in SCENE_DICT.values():
            scenes[:] = [scene for scene in scenes if scene_key(scene.__name__) != key]
        MU_DICT[key] = target_class
        SCENE_DICT.setdefault(scene_type.lower(), []).append(target_class)
        return target_class

    return register


def get_scene_dict(scene_type: str | None = None) -> Any:
    """Return the classes by scene type, or the classes of one type; raise an UnknownNameError if there is none."""
    return SCENE_DICT if scene_type is None else lookup(SCENE_DICT, "scene type", scene_type)


def get_scene_class(scene_name: str) -> Callable[[], "InitialSceneTemplates"]:
    """Return a scene by the name of its class in any spelling; raise an UnknownNameError if there is none."""
    return lookup(MU_DICT, "scene", scene_key(scene_name))


class InitialSceneTemplates:
    """A scene; subclasses define its regions and initial conditions.

    Attributes:
        workspace_name: Name of the workspace, such as `kitchen_table`.
        fixture_object_dict, movable_object_dict: Category -> names; `plate` -> `plate_1`.
        regions: Name -> arguments of `get_region_dict`; filled by `define_regions`.
        xy_region_kwargs_list: Rectangles on the workspace, from `regions` unless `define_regions` sets it.
        affordance_region_kwargs_list: Regions of objects and fixtures, such as drawers.

    Args:
        workspace_name: A table, or `floor`.
        fixture_num_info: Category -> number of the fixtures; the workspace may be among them.
        object_num_info: Category -> number of the movable objects, in the order of their joints.

    Raises:
        UnknownNameError: The workspace or a category does not exist.
    """

    def __init__(
        self,
        workspace_name: str = "main_table",
        fixture_num_info: Counts = MappingProxyType({}),
        object_num_info: Counts = MappingProxyType({}),
    ):
        require_known("workspace", workspace_name, WORKSPACE_CATEGORIES)
        self.workspace_name = workspace_name
        self.fixture_num_info = {workspace_name: 1, **fixture_num_info}
        self.object_num_info = dict(object_num_info)
        self.fixture_object_dict = get_object_dict(self.fixture_num_info)
        self.movable_object_dict = get_object_dict(self.object_num_info)
        counts = {**self.fixture_num_info, **self.object_num_info}
        self.affordance_region_kwargs_list = get_affordance_region_kwargs_list_from_fixture_info(counts)
        self.regions: dict[str, dict[str, Any]] = {}
        self.xy_region_kwargs_list: list[dict[str, Any]] = []
        self.define_regions()
        if not self.xy_region_kwargs_list:
            self.xy_region_kwargs_list = get_xy_region_kwargs_list_from_regions_info(self.regions)

    def define_regions(self) -> None:
        """Fill `regions`."""
        raise NotImplementedError(f"{type(self).__name__} must define where its objects are: define_regions")

    @property
    def init_states(self) -> Sequence[Sequence[str]]:
        """Initial conditions such as `("On", "plate_1", "kitchen_table_plate_init_region")`."""
        raise NotImplementedError(f"{type(self).__name__} must define what holds at the start: init_states")

    def get_region_dict(
        self,
        region_centroid_xy: Sequence[float],
        region_name: str,
        target_name: str | None = None,
        region_half_len: float | Sequence[float] = 0.02,
        yaw_rotation: Sequence[float] = (0.0, 0.0),
    ) -> dict[str, dict[str, Any]]:
        """Return a rectangle, by default on the workspace, for `regions.update`; each name once.

        See `bddl_generation_utils.get_xy_region`.
        """
        if region_name in self.regions:
            raise LiberoError(f"{type(self).__name__}: region {region_name} is defined twice; rename one")
        facts = {
            "target_name": target_name or self.workspace_name,
            "region_centroid_xy": region_centroid_xy,
            "region_half_len": region_half_len,
            "yaw_rotation": yaw_rotation,
        }
        return {region_name: facts}

    movable_objects = property(lambda self: list(self.movable_object_dict.names), doc="Names of the objects.")

    @property
    def fixtures(self) -> list[str]:
        """Names of the fixtures, without the workspace."""
        return [name for name in self.fixture_object_dict.names if name != self.workspace_name]

    @property
    def possible_objects_of_interest(self) -> list[str]:
        """Names that a task may refer to: objects, fixtures, and their regions."""
        regions = [f"{k['target_name']}_{k['region_name']}" for k in self.affordance_region_kwargs_list]
        return [*self.movable_objects, *self.fixtures, *regions]


class BenchmarkScene(InitialSceneTemplates):
    """A scene of the benchmark; subclasses set its name in `libero_env.tasks`."""

    scene: ClassVar[str]

    def __init__(self) -> None:
        self.problem = self._problem()
        fixtures, objects = self.problem.fixtures, self.problem.objects
        workspace = next(name for name, category in fixtures.items() if name == category)
        super().__init__(workspace, Counter(fixtures.values()), Counter(objects.values()))

    def _problem(self) -> Problem:
        """Return the scene as a problem; its goal, which a problem needs, is of no interest."""
        (first, *_) = load_scene(self.scene)["objects"]
        name = first if isinstance(first, str) else next(iter(first))
        return build_problem(self.scene, {"name": self.scene, "goal": [f"Up {name}_1"]})

    def define_regions(self) -> None:
        """Fill `regions` with the rectangles of the scene, as centre and half size."""
        for region in self.problem.regions:
            if region.ranges:
                ((x0, y0, x1, y1),) = region.ranges
                centre, half = ((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2)
                yaw = region.yaw[0] if region.yaw else (0.0, 0.0)
                self.regions |= self.get_region_dict(centre, region.name, region.target, half, yaw)

    @property
    def init_states(self) -> list[tuple[str, ...]]:
        """Initial conditions of the scene."""
        return [(atom.predicate, *atom.args) for atom in self.problem.init]


def _scenes(scene_type: str, number: int) -> dict[str, type[BenchmarkScene]]:
    """Register `KitchenScene1` and so on, and return them by name."""
    scenes = {}
    for i in range(1, number + 1):
        name, scene = f"{scene_type.title().replace('_', '')}Scene{i}", f"{scene_type}_scene{i}"
        facts = {"__module__": "libero.libero.benchmark.mu_creation", "__doc__": f"`{scene}`", "scene": scene}
        scenes[name] = register_mu(scene_type)(type(name, (BenchmarkScene,), facts))
    return scenes


BENCHMARK_SCENES = _scenes("kitchen", 10) | _scenes("living_room", 6) | _scenes("study", 4)
