"""Suite -> names of its tasks, in order; without `libero_100`, which consists of two others."""

from libero_env.tasks import get_suite, suite_names

_SUITES = [name for name in suite_names() if name != "libero_100"]
libero_task_map = {name: [task.name for task in get_suite(name).tasks] for name in _SUITES}
