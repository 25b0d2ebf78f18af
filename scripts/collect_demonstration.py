"""Run `libero.scripts.demonstrations.collect_demonstration`."""

from libero.scripts.demonstrations import collect_demonstration

if __name__ == "__main__":
    raise SystemExit(collect_demonstration())
