"""Suite -> names of its tasks, in order; without those that consist of others."""

from libero._adapters.files import suite_tasks

libero_task_map = {name: [task.name for task in tasks] for name, tasks in suite_tasks().items()}
