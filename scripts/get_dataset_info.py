"""Run `libero.scripts.get_dataset_info`."""

from libero.scripts.get_dataset_info import main

if __name__ == "__main__":
    raise SystemExit(main())
