"""Task files of one's own: one task, several, or a suite of them."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.tasks import bddl
from libero_env.tasks.authoring import read_facts, task_of
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.suites import get_suite, suite_names
from libero_env.tasks.task import Suite, Task

OWN = "own"  # suite of one's own files


def read_yaml_tasks(path: str | Path) -> tuple[Task, ...]:
    """The task of a YAML file; or several, which stand below `tasks` and share what the file says beside that.

    Raises:
        LiberoError: as `make_task`, and where the file is no YAML; the message names the file.
    """
    path = Path(path)
    facts = read_facts(path)
    if "tasks" not in facts:
        return (task_of({"name": path.stem, **facts}, str(path), path.parent),)
    shared = {key: value for key, value in facts.items() if key != "tasks"}
    return tuple(
        task_of({**shared, **own}, f"{path}, task {i}", path.parent) for i, own in enumerate(facts["tasks"])
    )


def read_suite(files: Iterable[str | Path], name: str = OWN) -> Suite:
    """A suite of one's own: the tasks of BDDL and YAML files, in their order.

    Raises:
        LiberoError: a file that cannot be read, two tasks of one name, or no file.
    """
    tasks: list[Task] = []
    for file in files:
        tasks += read_yaml_tasks(file) if Path(file).suffix in (".yaml", ".yml") else [read_task(file)]
    names = [task.name for task in tasks]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise LiberoError(
            f"two tasks of the suite {name} are called {', '.join(twice)}; rename one of their files"
        )
    if not tasks:
        raise LiberoError(f"the suite {name} has no files; name some that end in .yaml or .bddl")
    return Suite(name, tuple(replace(task, suite=name, index=i) for i, task in enumerate(tasks)))


def write_task(task: Task, path: str | Path) -> Path:
    """Write a task's BDDL; what reads it takes its instruction from the file's name.

    Raises:
        LiberoError: the file's name does not end in .bddl.
    """
    path = Path(path)
    if path.suffix != ".bddl":
        raise LiberoError(f"{path}: task files are .bddl")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(task.bddl_text, encoding="utf-8")
    return path


ENDINGS = (".bddl", ".yaml", ".yml")  # of task files


def get_task(key: str) -> Task:
    """The task called `suite/index`, `suite-index` or by its name alone; or of a file, see `read_task`.

    Raises:
        UnknownNameError: no such suite, index or task.
        LiberoError: the file is not a task.
    """
    if key.endswith(ENDINGS):
        return read_task(key)
    for mark in "/-":
        suite_name, found, index = key.rpartition(mark)
        if found:
            suite = get_suite(suite_name)
            if not index.isdecimal() or int(index) >= len(suite):
                raise UnknownNameError(f"index of {suite_name}", index, range(len(suite)))
            return suite.tasks[int(index)]
    named = {task.name: task for name in suite_names() for task in get_suite(name).tasks}
    if key not in named:
        raise UnknownNameError("task", key, named)
    return named[key]


def read_task(path: str | Path) -> Task:
    """A task of your own from a BDDL or YAML file; its suite is `file`, its name the file's.

    A BDDL file's instruction is that of its name, as in the original; a YAML file's what it says, see
    `libero_env.tasks.authoring`.

    Raises:
        BDDLError: the file is not a task; the message starts with file:line.
        LiberoError: a YAML file that is not one task.
    """
    if str(path).endswith(ENDINGS[1:]):
        from libero_env.tasks.files import read_yaml_tasks

        tasks = read_yaml_tasks(path)
        if len(tasks) != 1:
            raise LiberoError(
                f"{path} holds {len(tasks)} tasks, and one is wanted; put it in a file of its own"
            )
        return tasks[0]
    problem, name = bddl.read(path), Path(path).stem
    return Task("file", 0, name, language_from_name(name), problem.language, problem)
