"""Run `libero.scripts.render_single_task`."""

from libero.scripts.render_single_task import main

if __name__ == "__main__":
    raise SystemExit(main())
