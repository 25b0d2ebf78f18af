"""Run `libero.scripts.files.shasum_files`."""

from libero.scripts.files import shasum_files

if __name__ == "__main__":
    raise SystemExit(shasum_files())
