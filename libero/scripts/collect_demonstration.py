"""Record demonstrations of a task file by hand. An episode ends when its goal has held for ten steps."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from libero.scripts.command import run
from libero_env.cli.teleop import add_device, run_teleop
from libero_env.errors import LiberoError
from libero_env.tasks import read_task


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = make_parser("collect_demonstration.py", __doc__)
    parser.add_argument("--bddl-file", type=Path, required=True, help="the task")
    return run(parser, collect, argv)


def make_parser(prog: str, description: str | None) -> argparse.ArgumentParser:
    """The options that both scripts have."""
    parser = argparse.ArgumentParser(prog=prog, description=description)
    add = parser.add_argument
    add(
        "--directory",
        type=Path,
        default=Path("demonstration_data"),
        help="for the files (demonstration_data)",
    )
    add("--robots", nargs="+", default=["Panda"], help="Panda; there is no other")
    add("--config", default="single-arm-opposed", help="of two arms; without effect")
    add("--arm", default="right", help="of two arms; without effect")
    add("--camera", default="agentview", help="what is shown (default: agentview)")
    add("--controller", default="OSC_POSE", help="OSC_POSE; there is no other")
    add("--num-demonstration", type=int, default=50, help="that the file shall have (default: 50)")
    add("--size", type=int, default=128, help="of the recorded pictures, pixels (default: 128)")
    add("--seed", type=int, default=0, help="of the starts (default: 0)")
    add("--screen", default="auto", choices=("auto", "window", "terminal"), help="where it is shown")
    add_device(parser)
    return parser


def collect(args: argparse.Namespace) -> int:
    """Record into `<directory>/<problem>_<task>/demo.hdf5`; 1 where the user stopped before all were done.

    Raises:
        LiberoError: a robot or controller that there is not, or no demonstrations are wanted.
    """
    robots = [args.robots] if isinstance(args.robots, str) else args.robots
    for option, found, known in (
        ("--robots", robots, ["Panda"]),
        ("--controller", args.controller, "OSC_POSE"),
    ):
        if found != known:
            raise LiberoError(f"{option} {found}: demonstrations are recorded with {known} only")
    if args.num_demonstration < 1:
        raise LiberoError(f"--num-demonstration {args.num_demonstration}: expected at least 1")
    task = read_task(args.bddl_file)
    args.out = args.directory / f"{task.problem.name.lower()}_{task.name}" / "demo.hdf5"
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.task, args.bddl, args.n, args.size = (
        None,
        args.bddl_file,
        args.num_demonstration,
        (args.size, args.size),
    )
    return run_teleop(args)


if __name__ == "__main__":
    raise SystemExit(main())
