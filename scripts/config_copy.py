"""Run `libero.scripts.config_copy`."""

from libero.scripts.config_copy import main

if __name__ == "__main__":
    raise SystemExit(main())
