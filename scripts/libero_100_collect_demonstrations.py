"""Run `libero.scripts.libero_100_collect_demonstrations`."""

from libero.scripts.libero_100_collect_demonstrations import main

if __name__ == "__main__":
    raise SystemExit(main())
