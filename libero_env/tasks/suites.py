"""Suites and tasks by name, and from user-defined files: one task, several, or a suite of files."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from libero_env.doors import doors, enter
from libero_env.errors import InvalidInputError, LiberoError, UnknownNameError
from libero_env.tasks import bddl
from libero_env.tasks.benchmark import benchmark_suite, benchmark_task, suite_names, task_names, task_of_file
from libero_env.tasks.builder import check_keys, task_from_definition
from libero_env.tasks.schema import Source, read_definition
from libero_env.tasks.task import FILE, Suite, Task
from libero_env.text import closest

MAX_TASKS = 1000  # of a file
OWN = "own"  # suite of user-defined task files
ENDINGS = (".bddl", ".yaml", ".yml")  # of the names of task files


def is_published(name: str) -> bool:
    """Return whether a name is that of a suite by others or of a part of it, whether its files are here or not."""
    return name.startswith(tuple(doors("suites")))


def is_suite(name: str) -> bool:
    """Return whether a name is that of a suite, whether its files are here or not."""
    return name in suite_names() or ("/" not in name and is_published(name))


def get_suite(name: str) -> Suite:
    """Return a suite of the benchmark, or of LIBERO-Plus or LIBERO-PRO.

    Args:
        name: Name such as `libero_object`; `suite_names()` lists them. Those of others, such as `libero_plus_goal`, are
            in `libero_env.published.suites`.

    Returns:
        The suite with its tasks in their published order; the same object at each call.

    Raises:
        UnknownNameError: No suite has this name; the message lists them.
        MissingPackageError: The suite is one of others, and its files are not here.
    """
    for beginning in doors("suites"):
        if name.startswith(beginning):
            return enter("suites", beginning)(name)
    return benchmark_suite(name)


def read_yaml_tasks(path: str | Path) -> tuple[Task, ...]:
    """Return the tasks of a YAML file: one, or the list below `tasks`; see `iter_yaml_tasks`."""
    return tuple(task for task, _ in iter_yaml_tasks(path))


def iter_yaml_tasks(path: str | Path) -> Iterator[tuple[Task, Source]]:
    """Yield the tasks of a YAML file, which share its keys beside `tasks`, and where each stands.

    Raises:
        LiberoError: The file is not valid YAML, or a task is not valid (see `make_task`); the message names the file.
    """
    path = Path(path)
    definition, source = read_definition(path)
    check_keys(definition, source, "tasks")
    if "tasks" not in definition:
        yield task_from_definition({"name": path.stem, **definition}, source), source
        return
    shared = {key: value for key, value in definition.items() if key != "tasks"}
    tasks = definition["tasks"]
    if not isinstance(tasks, list) or len(tasks) > MAX_TASKS:
        raise InvalidInputError(f"{source.at('tasks')}: expected a list of at most {MAX_TASKS} tasks")
    names = set[str]()
    for i, own in enumerate(tasks):
        if not isinstance(own, dict) or not all(isinstance(key, str) for key in own):
            raise InvalidInputError(f"{source.at('tasks', i)}: expected keys such as name, goal and language")
        place = replace(source, line_of=source.shared_with(list(own), i), places={})
        task = task_from_definition({**shared, **own}, place, shares_with="with" not in own)
        if task.name in names:
            raise InvalidInputError(
                f"{source.at('tasks', i)}: two tasks are named {task.name}; give each a name or language of its own"
            )
        names.add(task.name)
        yield task, place


def find_tasks(names: Iterable[str]) -> list[Task]:
    """Return tasks, without duplicates, from names of suites, tasks of suites, and task files.

    Raises:
        LiberoError: A suite, task or file does not exist, or a file is not a task.
    """
    tasks: dict[tuple[str, str], Task] = {}
    for name in names:
        if name.endswith((".yaml", ".yml")):
            named = read_yaml_tasks(name)
        else:
            named = get_suite(name).tasks if is_suite(name) else (get_task(name),)
        tasks |= {(name if task.suite == FILE else task.suite, task.name): task for task in named}
    return list(tasks.values())


def read_suite(files: Iterable[str | Path], name: str = OWN) -> Suite:
    """Return a suite of user-defined tasks.

    Args:
        files: BDDL and YAML files, in the order of the tasks.

    Returns:
        The suite; its tasks have its name and consecutive indices.

    Raises:
        LiberoError: A file cannot be read, two tasks have the same name, or there is no file.
    """
    tasks: list[Task] = []
    for file in files:
        tasks += read_yaml_tasks(file) if Path(file).suffix in (".yaml", ".yml") else [read_task(file)]
    names = [task.name for task in tasks]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise LiberoError(
            f"two tasks of the suite {name} are named {', '.join(twice)}; rename one of their files"
        )
    if not tasks:
        raise LiberoError(f"the suite {name} has no files; give files that end in .yaml or .bddl")
    return Suite(name, tuple(replace(task, suite=name, index=i) for i, task in enumerate(tasks)))


def write_task(task: Task, path: str | Path) -> Path:
    """Write a task as a BDDL file. Readers take the instruction from its text; the original's from its name.

    Args:
        path: File to write, whose name ends in .bddl; its folder is created.

    Returns:
        `path`.

    Raises:
        LiberoError: The name of the file does not end in .bddl.
    """
    path = Path(path)
    if path.suffix != ".bddl":
        raise LiberoError(f"{path}: the name of a task file must end in .bddl")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(task.bddl_text, encoding="utf-8")
    return path


def get_task(key: str) -> Task:
    """Return a task of the benchmark, or that of a file.

    Args:
        key: `suite/index` or `suite-index` (`libero_object/3`), the name of a task, or the path of a file that ends in
            .bddl, .yaml or .yml (see `read_task`).

    Returns:
        The task.

    Raises:
        UnknownNameError: The suite, index or task does not exist; the message lists the valid ones.
        LiberoError: The file is not a valid task, or the name is that of a suite.
    """
    if key.endswith(ENDINGS):
        return read_task(key)
    if os.sep in key and Path(key).exists():
        raise LiberoError(f"{key} is not a task file; give the path of a file that ends in .bddl or .yaml")
    if is_suite(key):
        last = len(get_suite(key)) - 1
        raise LiberoError(
            f"{key} is a suite of {last + 1} tasks, not a task; write {key}/0 to {key}/{last}, or the name of a task "
            f"(`libero tasks list {key}`)"
        )
    for mark in "/-":
        suite_name, has_mark, index = key.rpartition(mark)
        if has_mark and (mark == "/" or index.isdecimal() or is_suite(suite_name)):
            suite = get_suite(suite_name)
            if not index.isdecimal() or len(index) > 9 or int(index) >= len(suite):
                raise UnknownNameError(f"index of {suite_name}", index, range(len(suite)))
            return suite.tasks[int(index)]
    if key in task_names():
        return benchmark_task(key)
    if closest(key, suite_names()):
        raise UnknownNameError("suite", key, suite_names())
    indices = [f"{name}/0 to {name}/{len(get_suite(name)) - 1}" for name in suite_names()]
    raise UnknownNameError("task", key, indices, unlisted=task_names())


def read_task(path: str | Path) -> Task:
    """Return the user-defined task of a BDDL or YAML file.

    The instruction is that of the file, see `libero_env.tasks.benchmark.task_of_file` and `libero_env.tasks.builder`.

    Args:
        path: File to read. Without `name` in a YAML file, its stem is the name of the task.

    Returns:
        The task; its suite is `file` and its index 0.

    Raises:
        BDDLError: The BDDL file is not valid; the message starts with file:line.
        LiberoError: The YAML file is not valid, or contains several tasks.
    """
    if str(path).endswith(ENDINGS[1:]):
        tasks = read_yaml_tasks(path)
        if len(tasks) != 1:
            raise LiberoError(
                f"{path} contains {len(tasks)} tasks, expected one; put each in a separate file"
            )
        return tasks[0]
    return task_of_file(Path(path).stem, bddl.read(path))
