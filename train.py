"""Learn a sequence of tasks: `python train.py algo=ewc benchmark=libero_object`, as `libero train` does."""

import sys

from lifelong.launch import main

if __name__ == "__main__":
    sys.exit(main())
