"""Run `libero.scripts.files.config_copy`."""

from libero.scripts.files import config_copy

if __name__ == "__main__":
    raise SystemExit(config_copy())
