"""Run `libero.scripts.get_affordance_info`."""

from libero.scripts.get_affordance_info import main

if __name__ == "__main__":
    raise SystemExit(main())
