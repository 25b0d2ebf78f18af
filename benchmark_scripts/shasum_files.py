"""Run `libero.scripts.shasum_files`."""

from libero.scripts.shasum_files import main

if __name__ == "__main__":
    raise SystemExit(main())
