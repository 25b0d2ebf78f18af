"""`python -m lifelong.cli`."""

import sys

from libero_eval.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
