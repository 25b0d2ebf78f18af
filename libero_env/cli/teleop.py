"""`libero teleop`: record demonstrations by hand."""

import argparse
from pathlib import Path

from libero_env.cli.arguments import positive, size


def register(subparsers: "argparse._SubParsersAction") -> None:
    """`libero teleop TASK`"""
    parser = subparsers.add_parser("teleop", help="record demonstrations by hand: keyboard or 3D mouse")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("task", nargs="?", help="such as libero_goal/3")
    what.add_argument("--bddl", type=Path, help="a task file of your own")
    add = parser.add_argument
    add(
        "--out",
        type=Path,
        help="demonstration file (default: <task>_demo.hdf5 here); goes on where it was stopped",
    )
    add("--n", type=positive, default=1, help="demonstrations that it shall have (default: 1)")
    add("--size", type=size, default=(128, 128), help="of the pictures, 128 or 120x160 (default: 128)")
    add("--seed", type=int, default=0, help="of the starts (default: 0)")
    add("--camera", default="agentview", help="what is shown while recording (default: agentview)")
    add("--screen", default="auto", choices=("auto", "window", "terminal"), help="where it is shown")
    add_device(parser)
    parser.set_defaults(run=run_teleop)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Options about what the user acts through."""
    add = parser.add_argument
    add("--device", default="keyboard", choices=("keyboard", "spacemouse"), help="what you act through")
    add("--pos-sensitivity", type=float, default=1.0, help="factor on motions (default: 1)")
    add("--rot-sensitivity", type=float, default=1.0, help="factor on turns (default: 1)")
    add("--vendor-id", type=int, default=9583, help="of the 3D mouse")
    add("--product-id", type=int, default=50741, help="of the 3D mouse")


def run_teleop(args: argparse.Namespace) -> int:
    """Record; 1 where the user stopped before all were done."""
    from libero_env.tasks import get_task, read_task
    from libero_env.teleop.devices import HELP, Keyboard, SpaceMouse
    from libero_env.teleop.screens import MouseReader, open_screen
    from libero_env.teleop.session import Teleop, record_by_hand

    task = read_task(args.bddl) if args.bddl else get_task(args.task)
    out = args.out or Path(f"{task.name}_demo.hdf5")
    sensitivity = args.pos_sensitivity, args.rot_sensitivity
    reader = None
    if args.device == "spacemouse":
        device: Keyboard = SpaceMouse(*sensitivity)
        assert isinstance(device, SpaceMouse)
        reader = MouseReader(device, args.vendor_id, args.product_id)
    else:
        device = Keyboard(*sensitivity)
    print(f"{task.language}\n{HELP}")
    screen = open_screen(args.screen, device, args.camera, reader)
    try:
        teleop = Teleop(task, device, screen, seed=args.seed)
        try:
            done = record_by_hand(teleop, out, args.n, size=args.size, tell=print)
        finally:
            teleop.close()
    finally:
        screen.close()
    print(f"{out}: {done} of {args.n} demonstrations")
    return int(done < args.n)
