"""Run `libero.scripts.demonstrations.check_dataset_integrity`."""

from libero.scripts.demonstrations import check_dataset_integrity

if __name__ == "__main__":
    raise SystemExit(check_dataset_integrity())
