"""Suite -> names of its tasks, in order; without those that consist of others."""

from libero_env.tasks import get_suite, suite_names

_SUITES = [name for name in suite_names() if name not in ("libero_100", "libero_130")]
libero_task_map = {name: [task.name for task in get_suite(name).tasks] for name in _SUITES}
