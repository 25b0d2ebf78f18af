"""Run `libero.scripts.tasks.create_libero_task_example`."""

from libero.scripts.tasks import create_libero_task_example

if __name__ == "__main__":
    raise SystemExit(create_libero_task_example())
