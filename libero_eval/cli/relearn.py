"""`libero relearn`: how many steps a forgotten task takes until it is back."""

import argparse

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers
from libero_eval.cli import options


def register(subparsers: Subparsers) -> None:
    """Add the command `libero relearn RUN`."""
    parser = subparsers.add_parser("relearn", help="steps until the forgotten tasks of a run are back")
    parser.add_argument("run_dir", type=arguments.path, metavar="RUN", help="the directory of a finished run")
    parser.add_argument(
        "--tasks",
        type=arguments.whole(0),
        nargs="+",
        metavar="K",
        help="positions in the run's sequence, from 0 (default: all but the last)",
    )
    parser.add_argument(
        "--steps", type=arguments.whole(1), default=400, help="steps until it is given up (default: 400)"
    )
    parser.add_argument(
        "--every", type=arguments.whole(1), default=20, help="steps between measurements (default: 20)"
    )
    parser.add_argument(
        "--tolerance",
        type=arguments.number(0, 10),
        default=0.05,
        help="share by which the error may exceed that just after learning, or the difference by which success may "
        "fall short of it (default: 0.05)",
    )
    parser.add_argument(
        "--held-out",
        type=arguments.whole(1, 1000),
        default=5,
        help="demonstrations to measure the error on, after those that were learned from (default: 5)",
    )
    parser.add_argument(
        "--episodes",
        type=arguments.whole(0),
        default=0,
        help="rollouts to measure success by, instead of the error (default: 0, the error)",
    )
    parser.add_argument(
        "--initial",
        type=arguments.path,
        metavar="RUN",
        help="the pretrained weights that the run began with: a finished run, or one of its checkpoints",
    )
    options.add_loading(parser)
    parser.set_defaults(
        run=run_relearn, go_on="what is measured is kept: the same command goes on with the rest"
    )


def run_relearn(args: argparse.Namespace) -> None:
    """Measure what is not recorded yet, print a row for each task, and write the run's report again."""
    from libero_eval.relearning import RelearnSettings, relearn
    from lifelong.pretraining import initial_policy
    from lifelong.report.page import write_report
    from lifelong.results.relearning import read_relearning, savings_tables

    relearn(
        args.run_dir,
        initial_policy(args.run_dir, weights=args.initial, allow=args.allow),
        tasks=args.tasks,
        settings=RelearnSettings(args.steps, args.every, args.tolerance, args.held_out, args.episodes),
        device=args.device,
        allow=args.allow,
    )
    print(savings_tables(read_relearning(args.run_dir)))
    print(write_report([args.run_dir]))
