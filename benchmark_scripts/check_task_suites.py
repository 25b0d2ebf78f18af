"""Run `libero.scripts.tasks.check_task_suites`."""

from libero.scripts.tasks import check_task_suites

if __name__ == "__main__":
    raise SystemExit(check_task_suites())
