"""Run `libero.scripts.download_libero_datasets`."""

from libero.scripts.download_libero_datasets import main

if __name__ == "__main__":
    raise SystemExit(main())
