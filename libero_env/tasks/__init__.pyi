from .benchmark import suite_names
from .builder import make_task
from .expression import And, Atom, Count, ForAll, Never, Not, Or, Then
from .problem import Problem, Region
from .suites import find_tasks, get_suite, get_task, is_suite, read_suite, read_task, write_task
from .task import Suite, Task

__all__ = [
    "And",
    "Atom",
    "Count",
    "ForAll",
    "Never",
    "Not",
    "Or",
    "Problem",
    "Region",
    "Suite",
    "Task",
    "Then",
    "find_tasks",
    "get_suite",
    "get_task",
    "is_suite",
    "make_task",
    "read_suite",
    "read_task",
    "suite_names",
    "write_task",
]
