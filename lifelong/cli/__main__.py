"""`python -m lifelong.cli`."""

import sys

from lifelong.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
