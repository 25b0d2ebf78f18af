"""The tasks of the benchmark: facts in `data/`, turned into `Task` and `Suite` on demand."""

from libero_env.tasks.suites import Suite, Task, get_suite, get_task, read_task, suite_names

__all__ = ["Suite", "Task", "get_suite", "get_task", "read_task", "suite_names"]
