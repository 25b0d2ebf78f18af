"""Run `libero.scripts.tasks.get_affordance_info`."""

from libero.scripts.tasks import get_affordance_info

if __name__ == "__main__":
    raise SystemExit(get_affordance_info())
