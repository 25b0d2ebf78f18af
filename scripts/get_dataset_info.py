"""Run `libero.scripts.demonstrations.get_dataset_info`."""

from libero.scripts.demonstrations import get_dataset_info

if __name__ == "__main__":
    raise SystemExit(get_dataset_info())
