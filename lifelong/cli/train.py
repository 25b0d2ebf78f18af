"""`libero train`: Hydra reads its words."""

from collections.abc import Sequence

HELP = """\
usage: libero train [-m] [--config-dir DIR] [--cfg job] [OVERRIDE ...]

Learn a sequence of tasks, evaluate after each, and write a report. Overrides choose a file of a configuration
group (algo=ewc, benchmark=libero_goal, preset=paper) or set a key (train.lr=3e-4). A killed run resumes when the same
command is given again.

options:
  -m, --multirun    run every combination of values
  --config-dir DIR  a folder of configuration files to be added
  --cfg WHAT        print the configuration (job, hydra, all)

examples:
  libero train algo=ewc benchmark=libero_object
  libero train -m algo=sequential,er,ewc seed=1,2     a sweep, with one report that compares the runs
  libero train --config-dir my_configs algo=my_algo   files of your own beside the package's
  libero train --cfg job                              print the configuration, run nothing
  libero train --info searchpath                      where configuration files are
  torchrun --nproc-per-node 2 --no-python libero train   several processes or GPUs"""


def train(words: Sequence[str]) -> int:
    """Train as the overrides ask."""
    if {"-h", "--help"} & set(words):
        print(HELP)
        return 0
    from lifelong.launch import main

    return main(words)
