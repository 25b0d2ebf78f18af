"""`libero demos replay|rerender|filter|export`: what can be done with demonstration files."""

import argparse
from pathlib import Path


def register(commands: "argparse._SubParsersAction") -> None:
    """Add the subcommands to `libero demos`."""
    _register_replay(commands)
    _register_rerender(commands)
    _register_filter(commands)
    _register_export(commands)


def _register_replay(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser(
        "replay", help="go through demonstrations again; say what succeeds and drifts"
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--by", choices=("action", "state"), default="action", help="(default: action)")
    parser.add_argument("--demo", nargs="+", type=int, help="numbers of demonstrations (default: all)")
    parser.add_argument("--video", type=Path, help="film them, as .mp4 or .gif")
    parser.add_argument(
        "--cameras", nargs="+", default=("agentview",), help="of the film (default: agentview)"
    )
    parser.add_argument("--size", type=_size, default=(256, 256), help="of the film (default: 256)")
    parser.add_argument("--assets", help="where models come from: builtin, or a folder of the original's")
    parser.set_defaults(run=run_replay)


def _register_rerender(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("rerender", help="observe recorded states anew, with other cameras")
    parser.add_argument("file", type=Path)
    parser.add_argument("out", type=Path, help="the new file")
    parser.add_argument("--size", type=_size, default=(128, 128), help="128 or 120x160 (default: 128)")
    parser.add_argument("--cameras", nargs="+", default=("agentview", "robot0_eye_in_hand"))
    parser.add_argument("--depth", action="store_true", help="depth too, in metres")
    parser.add_argument("--segmentation", choices=("instance", "class", "element"), help="a segmentation too")
    parser.add_argument("--assets", help="where models come from: builtin, or a folder of the original's")
    parser.set_defaults(run=run_rerender)


def _register_filter(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("filter", help="keep what is wanted of a file")
    parser.add_argument("file", type=Path)
    parser.add_argument("out", type=Path, help="the new file")
    parser.add_argument("--success", action="store_true", help="only demonstrations that reached the goal")
    parser.add_argument("--no-ops", action="store_true", help="leave out steps in which nothing is wanted")
    parser.add_argument(
        "--threshold", type=float, default=1e-3, help="largest motion of a no-op (default: 0.001)"
    )
    parser.set_defaults(run=run_filter)


def _register_export(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("export", help="write files as one data set in another format")
    parser.add_argument("files", nargs="+", type=Path, help="files or folders")
    parser.add_argument("--out", type=Path, required=True, help="a new folder")
    parser.add_argument(
        "--format", choices=("lerobot",), default="lerobot", help="LeRobotDataset v3.0 (default)"
    )
    parser.add_argument(
        "--labels", choices=("expert", "executed"), default="expert", help="(default: expert)"
    )
    parser.set_defaults(run=run_export)


def run_replay(args: argparse.Namespace) -> int:
    """One line for each demonstration and one about all; 1 where one that succeeded does not."""
    from libero_env.demos.replay import replay
    from libero_env.demos.video import write_video
    from libero_env.timing import CONTROL_HZ

    demos = [f"demo_{number}" for number in args.demo] if args.demo else None
    cameras = tuple(args.cameras) if args.video else ()
    done, lost = [], 0
    for result in replay(
        args.file, by=args.by, demos=demos, cameras=cameras, size=args.size, assets=args.assets
    ):
        lost += result.recorded and not result.success
        told = "success" if result.success else "no success"
        drift = f"objects {1000 * result.drift.max():.2f} mm, arm {1000 * result.arm_drift.max():.2f} mrad"
        print(f"{result.name}: {told} after {result.steps} steps, largest drift: {drift}")
        done.append(result)
    print(f"{sum(result.success for result in done)} of {len(done)} successful by {args.by}")
    if args.video and done:
        import numpy as np

        print(write_video(args.video, np.concatenate([result.frames for result in done]), CONTROL_HZ))
    return int(lost > 0)


def run_rerender(args: argparse.Namespace) -> None:
    """Write the new file and describe it."""
    from libero_env.cli.arguments import pictures
    from libero_env.demos.curate import describe
    from libero_env.demos.observe import Shots
    from libero_env.demos.replay import rerender

    print(
        describe(
            rerender(
                args.file, args.out, Shots(tuple(args.cameras), args.size, pictures(args)), assets=args.assets
            )
        )
    )


def run_filter(args: argparse.Namespace) -> None:
    """Write the new file and say what is in it."""
    from libero_env.demos.curate import examine, filter_demos

    print(f"{args.file}: {examine(args.file, threshold=args.threshold)}")
    stats = filter_demos(
        args.file, args.out, success_only=args.success, without_noops=args.no_ops, threshold=args.threshold
    )
    print(f"{args.out}: {stats}")


def run_export(args: argparse.Namespace) -> None:
    """Write the data set and say how much is in it."""
    from libero_env.demos.curate import find_files
    from libero_env.demos.lerobot import export

    episodes, frames = export(find_files(args.files), args.out, labels=args.labels)
    print(f"{args.out}: {episodes} episodes, {frames} frames")


def _size(text: str) -> tuple[int, int]:
    from libero_env.cli.arguments import size

    return size(text)
