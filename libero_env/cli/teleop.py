"""`libero teleop`: record demonstrations with a keyboard or a 3D mouse."""

import argparse
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add `libero teleop TASK`."""
    parser = subparsers.add_parser("teleop", help="record demonstrations by hand: keyboard or 3D mouse")
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("task", nargs="?", help="such as libero_goal/3")
    task.add_argument("--bddl", type=arguments.path, help="a user-defined task file")
    add = parser.add_argument
    add(
        "--out",
        type=arguments.path,
        help="demonstration file (default: <task>_demo.hdf5 here); demonstrations that it has are kept",
    )
    add(
        "--n", type=arguments.positive, default=1, help="demonstrations that the file shall have (default: 1)"
    )
    add(
        "--size",
        type=arguments.size,
        default=(128, 128),
        help="size of the images, 128 or 120x160 (default: 128)",
    )
    add("--seed", type=arguments.seed, default=0, help="seed of the starts (default: 0)")
    add("--camera", default="agentview", help="camera shown while recording (default: agentview)")
    add("--screen", default="auto", choices=("auto", "window", "terminal"), help="where it is shown")
    add_device_options(parser)
    parser.set_defaults(run=run_teleop, go_on="what is recorded is kept; the same command goes on")


def add_device_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the input device."""
    add, sensitivity, usb_id = parser.add_argument, arguments.number(-100, 100), arguments.whole(0, 0xFFFF)
    add("--device", default="keyboard", choices=("keyboard", "spacemouse"), help="input device")
    add("--pos-sensitivity", type=sensitivity, default=1.0, help="factor on translations (default: 1)")
    add("--rot-sensitivity", type=sensitivity, default=1.0, help="factor on rotations (default: 1)")
    add("--vendor-id", type=usb_id, default=9583, help="USB vendor of the 3D mouse (default: 9583)")
    add("--product-id", type=usb_id, default=50741, help="USB product of the 3D mouse (default: 50741)")


def run_teleop(args: argparse.Namespace) -> int:
    """Record demonstrations; return 1 if the user stopped before all were recorded."""
    from libero_env.tasks import get_task, read_task
    from libero_env.teleop.devices import HELP, Keyboard, SpaceMouse
    from libero_env.teleop.screens import MouseReader, open_screen
    from libero_env.teleop.session import Teleop, record_session

    task = read_task(args.bddl) if args.bddl else get_task(args.task)
    out = args.out or Path(f"{task.name}_demo.hdf5")
    sensitivity = args.pos_sensitivity, args.rot_sensitivity
    device, reader = Keyboard(*sensitivity), None
    if args.device == "spacemouse":
        device = mouse = SpaceMouse(*sensitivity)
        reader = MouseReader(mouse, args.vendor_id, args.product_id)
    print(f"{task.language}\n{HELP}")
    screen = open_screen(args.screen, device, args.camera, reader)
    try:
        teleop = Teleop(task, device, screen, seed=args.seed)
        try:
            recorded = record_session(teleop, out, args.n, size=args.size, report=print)
        finally:
            teleop.close()
    finally:
        screen.close()
    print(f"{out}: {recorded} of {args.n} demonstrations")
    return int(recorded < args.n)
