"""Run `libero.scripts.demonstrations.create_dataset`."""

from libero.scripts.demonstrations import create_dataset

if __name__ == "__main__":
    raise SystemExit(create_dataset())
