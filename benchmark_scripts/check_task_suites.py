"""Run `libero.scripts.check_task_suites`."""

from libero.scripts.check_task_suites import main

if __name__ == "__main__":
    raise SystemExit(main())
