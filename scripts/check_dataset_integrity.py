"""Run `libero.scripts.check_dataset_integrity`."""

from libero.scripts.check_dataset_integrity import main

if __name__ == "__main__":
    raise SystemExit(main())
