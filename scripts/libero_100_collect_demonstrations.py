"""Run `libero.scripts.demonstrations.libero_100_collect_demonstrations`."""

from libero.scripts.demonstrations import libero_100_collect_demonstrations

if __name__ == "__main__":
    raise SystemExit(libero_100_collect_demonstrations())
