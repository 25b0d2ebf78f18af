"""Suites of the benchmark, from the YAML files in `data/`."""

from functools import cache

from libero_env.errors import require_known
from libero_env.storage import read_yaml
from libero_env.tasks.builder import build_problem, language_from_name
from libero_env.tasks.problem import Problem, same_meaning
from libero_env.tasks.task import FILE, Suite, Task


def suite_names() -> tuple[str, ...]:
    """Return the names of the suites; one that consists of others comes after them."""
    return tuple(_parts())


def _parts() -> dict[str, list[str]]:
    """Return suite -> the suites that it consists of; an empty list for a suite with tasks in its file."""
    parts: dict[str, list[str]] = {}
    for entry in read_yaml("tasks/data/suites.yaml"):
        parts |= entry if isinstance(entry, dict) else {entry: []}
    return parts


@cache
def task_names() -> dict[str, str]:
    """Return the suite of each task of the benchmark, by its name."""
    suites = [name for name, parts in _parts().items() if not parts]
    return {own["name"]: name for name in suites for own in read_yaml(f"tasks/data/{name}.yaml")["tasks"]}


def benchmark_task(name: str) -> Task:
    """Return the task of the benchmark with a name of `task_names`."""
    return next(task for task in benchmark_suite(task_names()[name]).tasks if task.name == name)


def task_of_file(name: str, problem: Problem) -> Task:
    """Return the task of a BDDL file on its own, whose instruction is its `:language`.

    Only that of a file that is the benchmark's, by name and content, is derived from its name, as in the original.

    Args:
        name: Name of the file, without its ending.
    """
    published = name in task_names() and same_meaning(benchmark_task(name).problem, problem)
    language = language_from_name(name) if published else problem.language
    return Task(FILE, 0, name, language, problem.language, problem)


@cache
def benchmark_suite(name: str) -> Suite:
    """Return a suite of the benchmark.

    Raises:
        UnknownNameError: No suite has this name; the message lists them.
    """
    parts = _parts()
    require_known("suite", name, parts)
    if parts[name]:
        return Suite(name, tuple(task for part in parts[name] for task in benchmark_suite(part).tasks))
    content = read_yaml(f"tasks/data/{name}.yaml")
    shared = {key: value for key, value in content.items() if key != "tasks"}
    tasks = []
    for index, own in enumerate(content["tasks"]):
        definition = {**shared, **own}
        problem = build_problem(definition.get("scene"), definition)
        tasks.append(
            Task(name, index, own["name"], language_from_name(own["name"]), problem.language, problem)
        )
    return Suite(name, tuple(tasks))
