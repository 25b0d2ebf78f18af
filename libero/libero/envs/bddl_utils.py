"""Task files as dictionaries and lists of the original; problem names and predicates in lower case."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from libero._adapters.files import suite_tasks
from libero.libero import get_libero_path
from libero_env.errors import BDDLError
from libero_env.sim.history import over_time
from libero_env.tasks import bddl
from libero_env.tasks.expression import And, Atom, Expression, ForAll, Not, Or
from libero_env.tasks.problem import Problem

_NO_YAW, _NO_COLOUR = [0, 0], [0, 0, 1, 0]


def read_problem(problem_filename: str) -> Problem:
    """Read a task file, see `task_file`; raise a BDDLError if it is not one, or not one of the original's."""
    path = task_file(problem_filename)
    problem = bddl.read(path)
    if part := next(over_time(problem.goal), None):
        line = bddl.read_text(path).lower().partition("(:goal")[0].count("\n") + 1
        what, valid = (
            f"{part} in the goal",
            "a goal without Then, Never and Count, which the original does not have",
        )
        raise BDDLError(what, f"{valid}; libero_env runs it", path, line)
    return problem


def get_problem_info(problem_filename: str) -> dict[str, str]:
    """Return problem class, domain and instruction of a task file."""
    problem = read_problem(problem_filename)
    return {
        "problem_name": problem.name.lower(),
        "domain_name": problem.domain,
        "language_instruction": problem.language.lower(),
    }


def robosuite_parse_problem(problem_filename: str) -> dict[str, Any]:
    """Return everything in a task file."""
    problem = read_problem(problem_filename)
    goal = problem.goal.parts if isinstance(problem.goal, And) else (problem.goal,)
    return {
        "problem_name": problem.name.lower(),
        "fixtures": _by_category(problem.fixtures),
        "regions": regions(problem),
        "objects": _by_category(problem.objects),
        "scene_properties": dict(problem.scene_properties),
        "initial_state": [as_list(atom) for atom in problem.init],
        "goal_state": [as_list(part) for part in goal],
        "language_instruction": problem.language.lower().split(),
        "language": problem.language,
        "obj_of_interest": list(problem.obj_of_interest),
    }


def get_regions(problem_filename: str) -> dict[str, dict[str, Any]]:
    """Return the regions of a task file by address."""
    return regions(read_problem(problem_filename))


def get_scenes(problem_filename: str) -> dict[str, str]:
    """Return the scene properties of a task file, such as the styles of floor and wall."""
    return dict(read_problem(problem_filename).scene_properties)


def regions(problem: Problem) -> dict[str, dict[str, Any]]:
    """Return the regions of a problem by address."""
    return {
        region.address: {
            "target": region.target,
            "ranges": [list(row) for row in region.ranges],
            "extra": [],
            "yaw_rotation": list(region.yaw[0]) if region.yaw else list(_NO_YAW),
            "rgba": list(region.rgba) or list(_NO_COLOUR),
        }
        for region in problem.regions
    }


def as_list(expression: Expression) -> list[Any]:
    """Return a goal or atom as nested lists: `["on", "plate_1", "flat_stove_1_cook_region"]`."""
    match expression:
        case Atom(predicate, args):
            return [predicate.lower(), *args]
        case And(parts) | Or(parts):
            return [type(expression).__name__.lower(), *map(as_list, parts)]
        case Not(part):
            return ["not", as_list(part)]
        case ForAll(variables, part):
            return ["forall", [list(variable) for variable in variables], as_list(part)]
    raise TypeError(f"not a goal: {expression!r}")


def as_expression(state: list[Any]) -> Expression:
    """Return a goal or atom of nested lists, the inverse of `as_list`; case does not matter."""
    head = str(state[0]).lower()
    if head in ("and", "or"):
        return (And if head == "and" else Or)(tuple(map(as_expression, state[1:])))
    if head == "not":
        return Not(as_expression(state[1]))
    if head == "forall":
        return ForAll(tuple((name, category) for name, category in state[1]), as_expression(state[2]))
    return Atom(head.capitalize(), tuple(map(str, state[1:])))


def _by_category(names: Mapping[str, str]) -> dict[str, list[str]]:
    by_category: dict[str, list[str]] = {}
    for name, category in names.items():
        by_category.setdefault(category, []).append(name)
    return by_category


def task_file(name: str | os.PathLike) -> str:
    """Return the path of a task file.

    A path that exists is returned unchanged. Otherwise a name without a folder, such as `Task.bddl_file`, and a path
    into a checkout of the original, `.../bddl_files/<suite>/<task>.bddl`, stand for the file of the benchmark.
    """
    path = Path(name)
    into_checkout = path.parts[-3:-2] == ("bddl_files",)
    if path.exists() or (path.name != str(name) and not into_checkout):
        return str(name)
    suites = [path.parent.name] if into_checkout else list(suite_tasks())
    files = [Path(get_libero_path("bddl_files"), suite, path.name) for suite in suites]
    existing = [file for file in files if file.exists()]
    return str(existing[0]) if len(existing) == 1 else str(name)
