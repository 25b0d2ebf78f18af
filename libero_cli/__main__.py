"""`python -m libero_cli`."""

import sys

from libero_cli.main import main

if __name__ == "__main__":
    sys.exit(main())
