"""Task files from descriptions of a scene and a task, with the original's generator functions.

The parts are values of `libero_env.tasks.problem`; those in `SUITE_GENERATORS` join them to a task file.
"""

import functools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from libero._adapters.lookup import lookup
from libero.libero.envs.bddl_utils import as_expression
from libero.libero.utils.object_utils import get_affordance_regions
from libero_env.assets.arena import load_workspace
from libero_env.errors import BDDLError, InvalidInputError
from libero_env.tasks import bddl
from libero_env.tasks.expression import And, Atom, Expression
from libero_env.tasks.problem import Problem, Region

_OWN_NAMES = ("kitchen_table", "living_room_table", "study_table", "coffee_table", "floor")
WORKSPACE_CATEGORIES = {"main_table": "table", **{name: name for name in _OWN_NAMES}}  # name -> category

Pair = Sequence[float]


def get_fixtures(object_dict: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return name -> category, from category -> names."""
    return {name: category for category, names in object_dict.items() for name in names}


get_objects = get_fixtures


class ObjectDict(dict[str, list[str]]):
    """Category -> names of its instances, in the order in which a task file declares them."""

    names = property(get_fixtures, doc="Name -> category.")


def object_naming_mapping(category_name: str, object_id: int) -> str:
    """Return the name of an object, `plate_2`; a workspace, of which there is one, has its own, `main_table`."""
    name = {category: name for name, category in WORKSPACE_CATEGORIES.items()}.get(category_name)
    if name and object_id > 1:
        raise InvalidInputError(f"{category_name}: {object_id} of them; a scene has one workspace")
    return name or f"{category_name}_{object_id}"


def get_object_dict(object_num_info: Mapping[str, int]) -> ObjectDict:
    """Return category -> names, from category, or name of a workspace, -> number."""
    objects = ObjectDict()
    for category, count in object_num_info.items():
        category = WORKSPACE_CATEGORIES.get(category, category)
        objects[category] = [object_naming_mapping(category, i) for i in range(1, count + 1)]
    return objects


def get_xy_region(
    region_name: str,
    target_name: str,
    region_centroid_xy: Pair = (0.0, 0.0),
    region_half_len: float | Pair = 0.02,
    yaw_rotation: Pair = (0.0, 0.0),
) -> Region:
    """Return a rectangle on a workspace.

    Args:
        region_name: Name of the region, such as `plate_init_region`.
        region_centroid_xy: Centre (x, y) in the frame of the workspace, m; or several, one for each rectangle.
        region_half_len: Half size, m: one number, or one along x and one along y.
        yaw_rotation: Range (low, high) of the rotation about the vertical, rad.
    """
    centres: Any = np.reshape(region_centroid_xy, (-1, 2)).tolist()
    half = (region_half_len,) * 2 if isinstance(region_half_len, int | float) else tuple(region_half_len)
    ranges = tuple((x - half[0], y - half[1], x + half[0], y + half[1]) for x, y in centres)
    low, high = map(float, yaw_rotation)
    return Region(region_name, target_name, ranges, ((low, high),))


def get_object_affordance_region(region_name: str, target_name: str) -> Region:
    """Return a region of an object or fixture, such as a drawer: a named site of its model."""
    return Region(region_name, target_name)


def region_module(
    xy_region_kwargs_list: Iterable[Mapping[str, Any]] | None = None,
    affordance_region_kwargs_list: Iterable[Mapping[str, Any]] | None = None,
) -> tuple[Region, ...]:
    """Return all regions, from arguments of `get_xy_region` and of `get_object_affordance_region`."""
    regions = [get_xy_region(**kwargs) for kwargs in xy_region_kwargs_list or ()]
    regions += [get_object_affordance_region(**kwargs) for kwargs in affordance_region_kwargs_list or ()]
    return tuple({region.address: region for region in regions}.values())  # each once


def get_init_state(init_states: Iterable[Sequence[str]]) -> tuple[Atom, ...]:
    """Return the initial conditions of tuples such as `("On", "plate_1", "kitchen_table_plate_init_region")`."""
    return tuple(Atom(predicate.capitalize(), tuple(map(str, args))) for predicate, *args in init_states)


def get_goal_state(goal_states: Sequence[Any]) -> Expression:
    """Return the goal of conditions that must all hold, or of one: `("Or", ("Open", "a"), ("Open", "b"))`."""
    states = [goal_states] if goal_states and isinstance(goal_states[0], str) else goal_states
    parts = tuple(as_expression(list(state)) for state in states)
    return parts[0] if len(parts) == 1 and not isinstance(parts[0], Atom) else And(parts)


def get_affordance_region_kwargs_list_from_fixture_info(fixture_info: Mapping[str, int]) -> list[dict]:
    """Return arguments of `get_object_affordance_region` for all regions of objects, from category -> number."""
    workspaces = {*WORKSPACE_CATEGORIES, *WORKSPACE_CATEGORIES.values()}
    objects = get_object_dict({c: n for c, n in fixture_info.items() if c not in workspaces})
    regions = get_affordance_regions(objects)
    return [
        {"region_name": region, "target_name": name}
        for category, names in objects.items()
        for name in names
        for region in regions.get(category, ())
    ]


def get_xy_region_kwargs_list_from_regions_info(regions_info: Mapping[str, Mapping]) -> list[dict]:
    """Return arguments of `get_xy_region`, from those that `InitialSceneTemplates.get_region_dict` returns."""
    return [{"region_name": name, **facts} for name, facts in regions_info.items()]


def _task_file(
    category: str,
    language: str,
    xy_region_kwargs_list: Iterable[Mapping[str, Any]] = (),
    affordance_region_kwargs_list: Iterable[Mapping[str, Any]] = (),
    fixture_object_dict: Mapping[str, Sequence[str]] | None = None,
    movable_object_dict: Mapping[str, Sequence[str]] | None = None,
    objects_of_interest: Iterable[str] = (),
    init_states: Iterable[Sequence[str]] = (),
    goal_states: Sequence[Any] = (),
) -> str:
    """Write the task file of a task on a workspace; raise a BDDLError for a name that is not declared."""
    try:
        problem = Problem(
            name=load_workspace(category).problem,
            domain="robosuite",
            language=" ".join(language.split()),
            regions=region_module(xy_region_kwargs_list, affordance_region_kwargs_list),
            fixtures=get_fixtures(fixture_object_dict or {}),
            objects=get_objects(movable_object_dict or {}),
            obj_of_interest=tuple(dict.fromkeys(objects_of_interest)),
            init=get_init_state(init_states),
            goal=get_goal_state(goal_states),
        )
        return bddl.write(problem)
    except InvalidInputError as error:
        raise BDDLError(str(error)) from None


SUITE_GENERATORS: dict[str, Callable[..., str]] = {
    name: functools.partial(_task_file, category) for name, category in WORKSPACE_CATEGORIES.items()
}
(
    tabletop_task_suites_generator,
    kitchen_table_task_suites_generator,
    living_room_table_task_suites_generator,
    study_table_task_suites_generator,
    coffee_table_task_suites_generator,
    floor_task_suites_generator,
) = SUITE_GENERATORS.values()


def get_suite_generator_func(workspace_name: str) -> Callable[..., str]:
    """Return the function that writes task files for a workspace; raise an UnknownNameError if there is none."""
    return lookup(SUITE_GENERATORS, "workspace", workspace_name)


def print_result(result: str) -> None:
    """Print a task file."""
    print(get_result(result))


def get_result(result: str | Sequence[str]) -> str:
    """Return a task file, which may be a list of lines, as one text."""
    return result if isinstance(result, str) else "\n".join(result)


def file_stem(scene_name: str, language: str) -> str:
    """Return what a task file is named, as the benchmark names its files."""
    words = re.sub(r"[^\w-]+", "_", language.strip().lower()).strip("_")
    return f"{scene_name.upper()}_{words}"


def save_to_file(
    result: str, scene_name: str, language: str, folder: str | Path = "", file_name: str = ""
) -> str:
    """Write a task file to `<folder>/<file_name>.bddl` and return its path.

    By default it is named as the benchmark names its files: `KITCHEN_SCENE1_open_the_bottom_drawer_of_the_cabinet`.
    """
    path = Path(folder) / f"{file_name or file_stem(scene_name, language)}.bddl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(get_result(result), encoding="utf-8")
    return str(path)
