"""Run `libero.scripts.collect_demonstration`."""

from libero.scripts.collect_demonstration import main

if __name__ == "__main__":
    raise SystemExit(main())
