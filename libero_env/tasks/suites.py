"""Suites of the benchmark by name."""

from functools import cache

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.tasks.builder import build_problem, language_from_name, load_data, load_scene
from libero_env.tasks.published.folders import is_published
from libero_env.tasks.task import Suite, Task


def suite_names() -> tuple[str, ...]:
    """Return the names that `get_suite` accepts; a suite that consists of others comes after them."""
    return tuple(_parts())


def _parts() -> dict[str, list[str]]:
    """Return suite -> the suites that it consists of; an empty list for a suite with tasks in its file."""
    found: dict[str, list[str]] = {}
    for entry in load_data("suites.yaml"):
        found |= entry if isinstance(entry, dict) else {entry: []}
    return found


def is_suite(name: str) -> bool:
    """Return whether a name is that of a suite, whether its files are here or not."""
    return name in suite_names() or ("/" not in name and is_published(name))


def get_suite(name: str) -> Suite:
    """Return a suite of the benchmark, or of LIBERO-Plus or LIBERO-PRO.

    Args:
        name: Name such as `libero_object`; `suite_names()` lists them. Those of others, such as `libero_plus_goal`, are
            in `libero_env.tasks.published.suites`.

    Returns:
        The suite with its tasks in their published order; the same object at each call.

    Raises:
        UnknownNameError: No suite has this name; the message lists them.
        MissingPackageError: The suite is one of others, and its files are not here.
    """
    if not is_published(name):
        return _own_suite(name)
    from libero_env.tasks.published.suites import published_suite  # which needs models of objects

    return published_suite(name)


@cache
def _own_suite(name: str) -> Suite:
    parts = _parts()
    if name not in parts:
        raise UnknownNameError("suite", name, parts)
    if parts[name]:
        return Suite(name, tuple(task for part in parts[name] for task in _own_suite(part).tasks))
    definition = load_data(f"{name}.yaml")
    return Suite(
        name, tuple(_task(name, i, {**definition, **task}) for i, task in enumerate(definition["tasks"]))
    )


def _task(suite: str, index: int, definition: dict) -> Task:
    name = definition["name"]
    if "scene" not in definition:
        raise LiberoError(f"task {name}: neither it nor {suite}.yaml has the key 'scene'; add it to the YAML")
    own = {key: value for key, value in definition.items() if key != "tasks"}
    problem = build_problem(load_scene(definition["scene"]), own)
    return Task(suite, index, name, language_from_name(name), problem.language, problem)
