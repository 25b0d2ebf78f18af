"""Run `libero.scripts.create_template`."""

from libero.scripts.create_template import main

if __name__ == "__main__":
    raise SystemExit(main())
