"""`libero demos replay|rerender|filter|export`: replay, render again, filter and convert demonstration files."""

import argparse
from dataclasses import replace

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers, modalities

_ASSETS = "where models come from: builtin, original, or a folder with the original's"


def register(commands: Subparsers) -> None:
    """Add the subcommands to `libero demos`."""
    _register_replay(commands)
    _register_rerender(commands)
    _register_filter(commands)
    _register_export(commands)


def _register_replay(commands: Subparsers) -> None:
    parser = commands.add_parser("replay", help="replay demonstrations and report success and drift")
    add = parser.add_argument
    add("file", type=arguments.path)
    add("--by", choices=("action", "state"), default="action", help="(default: action)")
    add("--demo", nargs="+", type=arguments.whole(0), help="numbers of demonstrations (default: all)")
    add("--video", type=arguments.path, help="video to write, .mp4, .webp or .gif")
    add("--cameras", nargs="+", default=("agentview",), help="cameras of the video (default: agentview)")
    add("--size", type=arguments.size, default=(256, 256), help="size of the video (default: 256)")
    add("--assets", help=_ASSETS)
    parser.set_defaults(run=run_replay)


def _register_rerender(commands: Subparsers) -> None:
    parser = commands.add_parser(
        "rerender", help="render the recorded states again, with other cameras or under perturbations"
    )
    add = parser.add_argument
    add("file", type=arguments.path)
    add("out", type=arguments.path, help="the new file")
    add(
        "--perturb",
        metavar="KIND=SEVERITY,...",
        help="perturbations that change what is seen or said, such as camera=0.3,light=0.5; each demonstration has a "
        "draw of its own. Size, cameras and drawing are then by default those of the file",
    )
    add("--perturb-seed", type=arguments.seed, default=0, help="seed of the draws (default: 0)")
    add("--size", type=arguments.size, help="128 or 120x160 (default: 128)")
    add("--cameras", nargs="+", help="cameras to render (default: agentview robot0_eye_in_hand)")
    add("--drawing", choices=("fast", "faithful"), help="how images are drawn (default: that of the models)")
    add("--depth", action="store_true", help="render depth too, in metres")
    add("--segmentation", choices=("instance", "class", "element"), help="render a segmentation too")
    add("--assets", help=_ASSETS)
    parser.set_defaults(run=run_rerender)


def _register_filter(commands: Subparsers) -> None:
    parser = commands.add_parser("filter", help="write some of the demonstrations or steps of a file")
    add = parser.add_argument
    add("file", type=arguments.path)
    add("out", type=arguments.path, help="the new file")
    add("--success", action="store_true", help="keep only demonstrations that reached the goal")
    add("--no-ops", action="store_true", help="leave out steps in which the action does nothing")
    add(
        "--threshold",
        type=arguments.number(0, 1),
        default=1e-3,
        help="largest motion of a no-op (default: 0.001)",
    )
    parser.set_defaults(run=run_filter)


def _register_export(commands: Subparsers) -> None:
    parser = commands.add_parser("export", help="write files as one data set in another format")
    add = parser.add_argument
    add("files", nargs="+", type=arguments.path, help="files or folders")
    add("--out", type=arguments.path, required=True, help="a new folder")
    add("--format", choices=("lerobot",), default="lerobot", help="LeRobotDataset v3.0 (default)")
    add("--labels", choices=("expert", "executed"), default="expert", help="(default: expert)")
    add(
        "--as",
        dest="published",
        metavar="SET",
        help="write what this published set is, lerobot/libero or physical-intelligence/libero: demonstrations are run "
        "again without no-ops, successes kept, images of 256 pixels turned as there",
    )
    add(
        "--settle",
        type=arguments.whole(0, 1000),
        default=10,
        help="with --as: waiting steps before the first action (default: 10)",
    )
    add("--assets", help=f"with --as: {_ASSETS} (default: the original's where they are installed)")
    add("--drawing", choices=("faithful", "fast"), default="faithful", help="with --as (default: faithful)")
    parser.set_defaults(run=run_export)


def run_replay(args: argparse.Namespace) -> int:
    """Print one line about each demonstration and one about all; return 1 if one that succeeded does not any more."""
    from libero_env.demos.replay import replay
    from libero_env.demos.video import check_video_path, write_video
    from libero_env.timing import CONTROL_HZ

    if args.video:
        check_video_path(args.video)
    demos = [f"demo_{number}" for number in args.demo] if args.demo else None
    cameras = tuple(args.cameras) if args.video else ()
    results, lost = [], 0
    for result in replay(
        args.file, by=args.by, demos=demos, cameras=cameras, size=args.size, assets=args.assets
    ):
        lost += result.recorded and not result.success
        outcome = "success" if result.success else "no success"
        drift = f"objects {1000 * result.drift.max():.2f} mm, arm {1000 * result.arm_drift.max():.2f} mrad"
        print(f"{result.name}: {outcome} after {result.steps} steps, largest drift: {drift}")
        results.append(result)
    print(f"{sum(result.success for result in results)} of {len(results)} successful by {args.by}")
    if args.video and results:
        import numpy as np

        frames = [result.frames for result in results if result.frames is not None]
        print(write_video(args.video, np.concatenate(frames), CONTROL_HZ))
    return int(lost > 0)


def run_rerender(args: argparse.Namespace) -> None:
    """Write the new file and describe it."""
    from libero_env.demos.config import RenderConfig
    from libero_env.demos.curate import describe
    from libero_env.demos.observe import recorded_rendering
    from libero_env.demos.rendering import rerender
    from libero_env.perturbations import parse_perturbations

    config = RenderConfig(drawing=args.drawing)
    if args.perturb is not None:
        perturb = parse_perturbations(args.perturb, args.perturb_seed)
        config = replace(recorded_rendering(args.file), perturb=perturb)
    chosen = {"cameras": args.cameras and tuple(args.cameras), "size": args.size, "drawing": args.drawing}
    if args.depth or args.segmentation or args.perturb is None:
        chosen["modalities"] = modalities(args)
    config = replace(config, **{key: value for key, value in chosen.items() if value is not None})
    print(describe(rerender(args.file, args.out, config, assets=args.assets)))


def run_filter(args: argparse.Namespace) -> None:
    """Write the new file; print the contents of both."""
    from libero_env.demos.curate import examine, filter_demos

    print(f"{args.file}: {examine(args.file, threshold=args.threshold)}")
    stats = filter_demos(
        args.file, args.out, success_only=args.success, without_noops=args.no_ops, threshold=args.threshold
    )
    print(f"{args.out}: {stats}")


def run_export(args: argparse.Namespace) -> None:
    """Write the data set and print its size."""
    from libero_env.demos.curate import find_demo_files
    from libero_env.demos.lerobot import export_lerobot, export_published
    from libero_env.demos.replay import Regeneration

    files = find_demo_files(args.files)
    if args.published is None:
        episodes, frames = export_lerobot(files, args.out, labels=args.labels)
        print(f"{args.out}: {episodes} episodes, {frames} frames")
        return
    config = Regeneration(
        settle_steps=args.settle, labels=args.labels, assets=args.assets, drawing=args.drawing
    )
    written = export_published(files, args.out, args.published, config)
    print(f"{args.out}: {written.episodes} episodes, {written.frames} frames, as {args.published}")
    print(f"models: {config.pack().name}, drawing: {config.drawing}")
    for where in written.failed:
        print(f"left out, does not reach the goal when it is run again: {where}")
