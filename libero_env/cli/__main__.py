"""`python -m libero_env.cli`."""

import sys

from libero_env.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
