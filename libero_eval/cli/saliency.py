"""`libero saliency`: where a policy looks."""

import argparse

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers
from libero_eval.cli import options


def register(subparsers: Subparsers) -> None:
    """Add the command `libero saliency RUN`."""
    parser = subparsers.add_parser("saliency", help="images of where a policy looks during a rollout")
    options.add_run(parser)
    parser.add_argument(
        "--task", type=arguments.whole(0), default=0, help="position in the run's sequence (default: 0)"
    )
    options.add_after(parser)
    parser.add_argument(
        "--start", type=arguments.whole(0, 49), default=0, help="initial state of the rollout (default: 0)"
    )
    parser.add_argument(
        "--moments", type=arguments.whole(1, 100), default=6, help="number of images (default: 6)"
    )
    parser.add_argument(
        "--stride",
        type=arguments.number(1, 128),
        default=8.0,
        help="distance of two places in pixels of a 128-pixel image (default: 8)",
    )
    parser.add_argument(
        "--horizon",
        type=arguments.horizon,
        default=200,
        help="maximum number of control steps (default: 200)",
    )
    options.add_loading(parser)
    parser.set_defaults(run=run_saliency)


def run_saliency(args: argparse.Namespace) -> None:
    """Draw a contact sheet in the run's folder `saliency`, and write the run's report again."""
    from libero_eval.saliency import SaliencySettings
    from libero_eval.saliency_sheet import draw_saliency
    from lifelong.report.page import write_report

    path = draw_saliency(
        args.policy,
        task=args.task,
        after=args.after,
        start=args.start,
        moments=args.moments,
        horizon=args.horizon,
        settings=SaliencySettings(stride=args.stride),
        device=args.device,
        allow=args.allow,
    )
    print(path)
    print(write_report([path.parents[1]]))
