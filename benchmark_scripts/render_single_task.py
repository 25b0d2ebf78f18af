"""Run `libero.scripts.tasks.render_single_task`."""

from libero.scripts.tasks import render_single_task

if __name__ == "__main__":
    raise SystemExit(render_single_task())
