"""Run `libero.scripts.files.create_template`."""

from libero.scripts.files import create_template

if __name__ == "__main__":
    raise SystemExit(create_template())
