"""Suite -> names of its tasks, in order."""

from libero_env.tasks import get_suite, suite_names

libero_task_map = {name: [task.name for task in get_suite(name).tasks] for name in suite_names()}
