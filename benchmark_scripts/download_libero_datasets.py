"""Run `libero.scripts.demonstrations.download_libero_datasets`."""

from libero.scripts.demonstrations import download_libero_datasets

if __name__ == "__main__":
    raise SystemExit(download_libero_datasets())
