"""Run `libero.scripts.create_dataset`."""

from libero.scripts.create_dataset import main

if __name__ == "__main__":
    raise SystemExit(main())
