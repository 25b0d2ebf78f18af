"""Record demonstrations of a task file by hand. An episode ends when its goal has held for ten steps."""

import argparse
from pathlib import Path

from libero.scripts.command import option, script
from libero_env.cli.teleop import TeleopRequest, teleop
from libero_env.errors import LiberoError
from libero_env.tasks import read_task

# Options of both scripts that record by hand.
OPTIONS = (
    option("--directory", type=Path, default=Path("demonstration_data"), help="folder of the files"),
    option("--robots", nargs="+", default=["Panda"], help="Panda is the only robot"),
    option("--config", default="single-arm-opposed", help="no effect: the benchmark has one arm"),
    option("--arm", default="right", help="no effect: the benchmark has one arm"),
    option("--camera", default="agentview", help="camera that is shown (default: agentview)"),
    option("--controller", default="OSC_POSE", help="OSC_POSE is the only controller"),
    option("--num-demonstration", type=int, default=50, help="demonstrations in the file (default: 50)"),
    option("--size", type=int, default=128, help="size of the recorded pictures, pixels (default: 128)"),
    option("--seed", type=int, default=0, help="seed of the initial states (default: 0)"),
    option("--screen", default="auto", choices=("auto", "window", "terminal"), help="where it is shown"),
    option("--device", default="keyboard", choices=("keyboard", "spacemouse"), help="input device"),
    option("--pos-sensitivity", type=float, default=1.0, help="factor on translations (default: 1)"),
    option("--rot-sensitivity", type=float, default=1.0, help="factor on rotations (default: 1)"),
    option("--vendor-id", type=int, default=9583, help="USB vendor of the 3D mouse (default: 9583)"),
    option("--product-id", type=int, default=50741, help="USB product of the 3D mouse (default: 50741)"),
)
DEVICE = ("device", "pos_sensitivity", "rot_sensitivity", "vendor_id", "product_id")


def collect(args: argparse.Namespace) -> int:
    """Record into `<directory>/<problem>_<task>/demo.hdf5`; return 1 where the user stopped early."""
    robots = [args.robots] if isinstance(args.robots, str) else args.robots
    for flag, got, known in (("--robots", robots, ["Panda"]), ("--controller", args.controller, "OSC_POSE")):
        if got != known:
            raise LiberoError(f"{flag} {got}: demonstrations are recorded with {known} only")
    if args.num_demonstration < 1:
        raise LiberoError(f"--num-demonstration {args.num_demonstration}: expected at least 1")
    task = read_task(args.bddl_file)
    out = args.directory / f"{task.problem.name.lower()}_{task.name}" / "demo.hdf5"
    out.parent.mkdir(parents=True, exist_ok=True)
    return teleop(
        TeleopRequest(
            bddl=args.bddl_file,
            out=out,
            n=args.num_demonstration,
            size=(args.size, args.size),
            seed=args.seed,
            camera=args.camera,
            screen=args.screen,
            **{name: getattr(args, name) for name in DEVICE},
        )
    )


@script(*OPTIONS, option("--bddl-file", type=Path, required=True, help="task file"))
def main(args: argparse.Namespace) -> int:
    """Record the demonstrations."""
    return collect(args)
