"""User-defined tasks: a scene and a goal in one YAML file, or in one call.

    scene: kitchen
    furniture: [wooden_cabinet]
    objects: [akita_black_bowl, plate]
    place:
      wooden_cabinet_1: {at: [0, -0.3], yaw: pi}
      akita_black_bowl_1: [0, 0]
      plate_1: {at: [0.05, 0.2], half: 0.02}
    goal: On akita_black_bowl_1 plate_1
    language: put the bowl on the plate

The keys are those of `libero_env.tasks.builder`, and the following short forms:

    scene      a scene of the benchmark with its objects (`kitchen_scene1`), an empty one (`kitchen`,
               `living_room`, `study`, `coffee`, `table`, `floor`), or the YAML file of a scene
    furniture  categories of fixtures, in addition to those of the scene; numbered like objects
    objects    categories of objects, in addition to those of the scene
    place      object or fixture: its initial place. Either [x, y] on the workspace in metres (x points away from the
               robot, y to its left), or `{at: [x, y], half: h, yaw: angle}` for any point within h of it, or its
               support: `plate_1`, `wooden_cabinet_1_top_side`, `In wooden_cabinet_1_top_region`. It replaces the place
               that the scene gives
    goal       one atom, several, or an expression; an atom is `On a b`, `(On a b)` or, in Python, `("On", "a", "b")`

Regions that are sites of a model, such as `basket_1_contain_region`, need no declaration.
"""

import re
from collections.abc import Mapping
from typing import Any

from libero_env.assets.arena import WORKSPACES, load_workspace
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.tasks import bddl
from libero_env.tasks.builder import KEYS, build_problem, language_from_name
from libero_env.tasks.checks import faults
from libero_env.tasks.expansion import EMPTY, expand, is_placement, model_regions, workspace_of
from libero_env.tasks.problem import Problem
from libero_env.tasks.source import Source, Trace
from libero_env.tasks.task import Task, check_name
from libero_env.text import suggest

__all__ = ["EMPTY", "FILE", "make_task", "model_regions", "task_from_definition"]

SHORT = ("scene", "furniture", "objects", "place", "goal", "name", "with")
_KEYS = tuple(dict.fromkeys((*SHORT, *KEYS)))
FILE = "file"  # suite of a task that was read from a file on its own
_SECTIONS = {  # section of a task file -> key of a YAML file
    ":domain": "problem",
    ":fixtures": "fixtures",
    ":goal": "goal",
    ":init": "init",
    ":language": "language",
    ":obj_of_interest": "obj_of_interest",
    ":objects": "objects",
    ":regions": "regions",
    ":scene_properties": "scene_properties",
}

Definition = Mapping[str, Any]


def make_task(name: str | None = None, **definition: Any) -> Task:
    """Return a user-defined task, from the keys that a task's YAML file may contain.

    Args:
        name: Name of the task and of its files; by default the words of the language, joined by underscores.
        definition: Keys such as `scene`, `objects`, `place`, `goal` and `language`, and their values; see
            `libero_env.tasks.authoring`. Values that are None are ignored.

    Returns:
        The task; its suite is `file`.

    Raises:
        LiberoError: A key, scene, object or region does not exist, or an object has no place; the message lists the
            valid names.

    Example:
        >>> task = make_task(
        ...     scene="kitchen",
        ...     objects=["red_coffee_mug", "plate"],
        ...     place={"red_coffee_mug_1": (0, 0), "plate_1": (0.05, 0.2)},
        ...     goal=("On", "red_coffee_mug_1", "plate_1"),
        ...     language="put the red mug on the plate",
        ... )
        >>> task.name
        'put_the_red_mug_on_the_plate'
    """
    definition = {key: value for key, value in definition.items() if value is not None}
    return task_from_definition({**definition, **({"name": name} if name else {})}, Source("task"))


def task_from_definition(definition: Definition, source: Source) -> Task:
    """Return the task of a definition; see `make_task`.

    Args:
        definition: Content of a YAML file.
        source: Where it stands.

    Raises:
        LiberoError: The definition is not valid; the message starts with file and line and lists the valid names.
    """
    check_keys(definition, source)
    trace = Trace(source)
    expanded = expand(
        {key: value for key, value in definition.items() if value is not None}, {}, source, trace
    )
    language = expanded.get("language") or language_from_name(expanded.get("name", ""))
    name = expanded.get("name") or re.sub(r"\W+", "_", language.strip().lower()).strip("_")
    if not language:
        raise InvalidInputError(
            f"{source.at()}: it has neither a name nor a language; add `language:` with the instruction"
        )
    try:
        check_name(name)
    except LiberoError as error:
        raise InvalidInputError(f"{source.at('language')}: {error}; add `name:`") from None
    problem = _problem({**expanded, "name": name, "language": language}, source, trace)
    return Task(FILE, 0, name, language, language, problem)


def check_keys(definition: Definition, source: Source, *more: str) -> None:
    """Check the keys of a definition.

    Raises:
        InvalidInputError: A key does not exist; the message has the nearest one.
    """
    for key in definition:
        if key not in (*_KEYS, *more):
            raise InvalidInputError(
                f"{source.at(key)}: {key} is an unknown key.{suggest(key, _KEYS)} Valid: {', '.join(_KEYS)}"
            )


def _problem(expanded: dict[str, Any], source: Source, trace: Trace) -> Problem:
    """Return the problem of the builder's keys, checked."""
    if not expanded["goal"]:
        raise InvalidInputError(
            f"{source.at()}: it has no goal; add one, such as `goal: On red_coffee_mug_1 plate_1`"
        )
    objects = {
        f"{category}_{i + 1}": category
        for named in expanded["objects"]
        for category, n in named.items()
        for i in range(n)
    }
    entities = {**expanded["fixtures"], **objects}
    placed = {atom.split()[1] for atom in expanded["init"] if is_placement(atom)}
    missing = [
        name for name, category in entities.items() if name not in placed and category not in WORKSPACES
    ]
    if missing:
        raise InvalidInputError(
            f"{source.at('place')}: {', '.join(missing)} has no place; add it below place: `{missing[0]}: [0, 0]`"
        )
    if "problem" not in expanded:
        expanded["problem"] = load_workspace(workspace_of(entities, source.at("fixtures"))[1]).problem
    regions = {f"{target}_{name}" for target, named in expanded["regions"].items() for name in named}
    known = {*entities, *regions}
    for atom in (*expanded["init"], *expanded["goal"]):
        place, line = trace.of(atom)
        parse = (
            bddl.parse_expression if atom in expanded["goal"] and atom.startswith("(") else bddl.parse_atom
        )
        parse(atom, known, place.name, line)
    if len(goal := expanded["goal"]) == 1 and goal[0].startswith("("):
        expanded["goal"] = goal[0]
    problem = build_problem({}, expanded)
    for fault in faults(problem):
        parts = {":init": problem.init, ":goal": problem.goal.atoms()}.get(fault.section, ())
        label = str(fault.part)
        if isinstance(fault.part, int) and fault.part < len(parts):
            label = str(parts[fault.part])[1:-1]
        where = trace.at(label, _SECTIONS.get(fault.section, ""))
        raise InvalidInputError(f"{where}: {fault.what}; expected {fault.expected}")
    return problem
