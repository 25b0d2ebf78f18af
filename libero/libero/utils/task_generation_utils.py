"""Tasks on registered scenes, and their task files."""

import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from libero._adapters.lookup import lookup
from libero._adapters.models import facade_pack
from libero.libero.envs.predicates import get_predicate_fn
from libero.libero.utils.bddl_generation_utils import (
    file_stem,
    get_goal_state,
    get_result,
    get_suite_generator_func,
    region_module,
    save_to_file,
)
from libero.libero.utils.mu_utils import InitialSceneTemplates, get_scene_class, scene_key
from libero_env.errors import LiberoError, require_known
from libero_env.tasks.bddl import parse
from libero_env.tasks.builder import entities_in_goal
from libero_env.workspaces import WORKSPACES

# Errors in user-defined scenes and tasks; each is reported for its task alone.
_FAULTS: tuple[type[Exception], ...] = (LiberoError, ArithmeticError, AttributeError, LookupError)
_FAULTS += (TypeError, ValueError, NotImplementedError)


class TaskInfoTuple(NamedTuple):
    """A task on a scene. `file_name` is the name of its task file without ending; empty for the default."""

    scene_name: str
    language: str
    objects_of_interest: Sequence[str]
    goal_states: Sequence[Any]
    file_name: str = ""


class Failure(NamedTuple):
    """A task file that could not be written, and why."""

    scene_name: str
    language: str
    cause: Exception


TASK_INFO: dict[str, list[TaskInfoTuple]] = {}


def register_task_info(
    language: Any,
    scene_name: str = "",
    objects_of_interest: Sequence[str] = (),
    goal_states: Sequence[Any] = (),
) -> Any:
    """Define a task on a scene and return it; a LiberoError states what is missing.

    A task of the same scene and instruction is replaced. As a decorator, it returns the class.

    Args:
        language: Instruction of the task. Or, as a class decorator, a class without arguments whose instances have
            `scene_name`, `language_instruction` and `goal`, and optionally `task_name` and `objects_of_interest`.
        scene_name: Name of a registered scene, in any spelling.
        objects_of_interest: Names; by default those in the goal.
        goal_states: Conditions that must all hold, such as `("On", "plate_1", "flat_stove_1_cook_region")`.
    """
    if isinstance(language, type):
        info = _info_of(language())
    else:
        interest, goal = tuple(objects_of_interest), tuple(goal_states)
        info = _checked(TaskInfoTuple(scene_key(scene_name), language, interest, goal))
    tasks = TASK_INFO.setdefault(info.scene_name, [])
    tasks[:] = [task for task in tasks if task.language != info.language] + [info]
    return language if isinstance(language, type) else info


def get_task_info(scene_name: str | None = None) -> Any:
    """Return the tasks by scene, or those of one scene; raise an UnknownNameError if it has none."""
    if scene_name is None:
        return TASK_INFO
    return lookup(TASK_INFO, "scene with tasks", scene_key(scene_name))


def generate_bddl_from_task_info(folder: Any = "", output_dir: str | os.PathLike = "") -> Any:
    """Write the task files of all registered tasks to `folder`, and return (paths, failures).

    Or write one task to `output_dir` and return its path: `folder` is an instance of a class that `register_task_info`
    decorates, or a `TaskInfoTuple`; a LiberoError states why it cannot be written.
    """
    if not isinstance(folder, str | os.PathLike):
        return _write(folder if isinstance(folder, TaskInfoTuple) else _info_of(folder), output_dir)
    paths: list[str] = []
    failures: list[Failure] = []
    for task in itertools.chain(*TASK_INFO.values()):
        try:
            name = task.file_name or file_stem(task.scene_name, task.language)
            if name in (Path(path).stem for path in paths):
                raise LiberoError(f"{name}: another task has this name")
            paths.append(_write(task, folder or output_dir))
        except _FAULTS as error:
            failures.append(Failure(task.scene_name, task.language, error))
    return paths, failures


def bddl_text(task: TaskInfoTuple) -> str:
    """Return the task file of a task; raise a LiberoError that names what does not exist or does not fit."""
    scene: InitialSceneTemplates = get_scene_class(task.scene_name)()
    goal, regions = get_goal_state(task.goal_states), region_module((), scene.affordance_region_kwargs_list)
    interest = entities_in_goal(goal, regions, scene.movable_objects, scene.fixtures)
    for name in task.objects_of_interest:
        require_known("object of interest", name, scene.possible_objects_of_interest)
    text = get_result(
        get_suite_generator_func(scene.workspace_name)(
            language=task.language,
            xy_region_kwargs_list=scene.xy_region_kwargs_list,
            affordance_region_kwargs_list=scene.affordance_region_kwargs_list,
            fixture_object_dict=scene.fixture_object_dict,
            movable_object_dict=scene.movable_object_dict,
            objects_of_interest=task.objects_of_interest or interest,
            init_states=scene.init_states,
            goal_states=task.goal_states,
        )
    )
    problem = parse(text)
    categories = {*facade_pack().categories(), *WORKSPACES}
    for category in [*problem.fixtures.values(), *problem.objects.values()]:
        require_known("object category", category, categories)
    for atom in [*problem.init, *problem.goal.atoms()]:
        get_predicate_fn(atom.predicate)
    return text


def _write(task: TaskInfoTuple, folder: str | os.PathLike) -> str:
    return save_to_file(bddl_text(task), task.scene_name, task.language, Path(folder), task.file_name)


def _info_of(task: Any) -> TaskInfoTuple:
    """Return the task that an instance of a task class describes."""
    goal = getattr(task, "goal", getattr(task, "goal_states", ()))
    keys = ("language_instruction", "language", "task_description")
    info = TaskInfoTuple(
        scene_name=scene_key(str(getattr(task, "scene_name", ""))),
        language=str(next((getattr(task, name) for name in keys if getattr(task, name, "")), "")),
        objects_of_interest=tuple(getattr(task, "objects_of_interest", ())),
        goal_states=tuple(goal() if callable(goal) else goal),
        file_name=str(getattr(task, "task_name", "")),
    )
    return _checked(info)


def _checked(task: TaskInfoTuple) -> TaskInfoTuple:
    """Return a task; raise a LiberoError if something is missing."""
    named = {"scene_name": task.scene_name, "language": task.language, "goal_states": task.goal_states}
    if missing := [name for name, value in named.items() if not value]:
        raise LiberoError(
            f"task {task.language or task.file_name!r}: no {' and no '.join(missing)}; expected scene_name, an "
            "instruction, and a goal such as [('On', 'plate_1', 'flat_stove_1_cook_region')]"
        )
    return task
