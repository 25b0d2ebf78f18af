"""The tasks of the benchmark: facts in `data/`, turned into `Task` and `Suite` on demand; and those of one's own."""

from libero_env.tasks.suites import Suite, Task, get_suite, get_task, read_task, suite_names

__all__ = [
    "Suite",
    "Task",
    "get_suite",
    "get_task",
    "make_task",
    "read_suite",
    "read_task",
    "suite_names",
    "write_task",
]


def __getattr__(name: str) -> object:
    """What makes tasks needs the objects, and they are not imported before it is asked for."""
    if name == "make_task":
        from libero_env.tasks.authoring import make_task

        return make_task
    if name in ("read_suite", "write_task"):
        from libero_env.tasks import files

        return getattr(files, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
