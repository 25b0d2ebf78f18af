"""Run `libero.scripts.create_libero_task_example`."""

from libero.scripts.create_libero_task_example import main

if __name__ == "__main__":
    raise SystemExit(main())
