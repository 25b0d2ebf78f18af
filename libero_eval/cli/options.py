"""Arguments that several commands share which load the policy of a run."""

import argparse

from libero_env.cli import arguments

ALLOW_HELP = (
    "packages of others whose classes a run's configuration, or a result that is run again, may name "
    "(default: none; their code is executed)"
)


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add the run whose policy is loaded, as `policy`."""
    parser.add_argument(
        "policy", type=arguments.path, metavar="RUN", help="a run's directory, or one of its checkpoints"
    )


def add_after(parser: argparse._ActionsContainer, of: str = "") -> None:
    """Add `--after`, the task after which the policy is taken; `of` is what help says before."""
    parser.add_argument(
        "--after", type=arguments.whole(0), help=f"{of}the policy after this task, from 0 (default: the last)"
    )


def add_loading(parser: argparse._ActionsContainer) -> None:
    """Add `--device` and `--allow`, by which `lifelong.evaluation.restore` loads a policy."""
    parser.add_argument("--device", type=arguments.device, default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument("--allow", nargs="+", default=[], metavar="PACKAGE", help=ALLOW_HELP)
