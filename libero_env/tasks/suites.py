"""Suites and tasks by name, with the original's task orders."""

from functools import cache

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.tasks.builder import build_problem, language_from_name, load_data, load_scene
from libero_env.tasks.task import Suite, Task


def suite_names() -> tuple[str, ...]:
    """The names that `get_suite` knows; a suite that consists of others comes after them."""
    return tuple(_parts())


def _parts() -> dict[str, list[str]]:
    """Suite -> the suites it consists of; none for a suite with tasks of its own."""
    found: dict[str, list[str]] = {}
    for entry in load_data("suites.yaml"):
        found |= entry if isinstance(entry, dict) else {entry: []}
    return found


@cache
def get_suite(name: str) -> Suite:
    """The suite of this name.

    Raises:
        UnknownNameError: no suite has this name; the message lists them.
    """
    parts = _parts()
    if name not in parts:
        raise UnknownNameError("suite", name, parts)
    if parts[name]:
        return Suite(name, tuple(task for part in parts[name] for task in get_suite(part).tasks))
    facts = load_data(f"{name}.yaml")
    return Suite(name, tuple(_task(name, i, {**facts, **task}) for i, task in enumerate(facts["tasks"])))


def _task(suite: str, index: int, facts: dict) -> Task:
    name = facts["name"]
    if "scene" not in facts:
        raise LiberoError(f"task {name}: neither it nor {suite}.yaml says 'scene'; add it to the YAML")
    own = {key: value for key, value in facts.items() if key != "tasks"}
    problem = build_problem(load_scene(facts["scene"]), own)
    return Task(suite, index, name, language_from_name(name), problem.language, problem)
