"""`libero tasks new` and `libero tasks preview`: write a user-defined task, and render it."""

import argparse
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(commands: Subparsers) -> None:
    """Add the commands `libero tasks new` and `libero tasks preview`."""
    _register_new(commands)
    _register_preview(commands)


def _register_new(commands: Subparsers) -> None:
    new = commands.add_parser("new", help="write a template of a user-defined task")
    add = new.add_argument
    add("name", help="name of the task; the file is NAME.yaml")
    add(
        "--scene",
        default="kitchen",
        help="kitchen, living_room, study, coffee, table, floor, or kitchen_scene1, ...",
    )
    add(
        "--objects",
        nargs="+",
        default=(),
        metavar="CATEGORY",
        help="such as red_coffee_mug plate (default: bowl, plate)",
    )
    add("--furniture", nargs="+", default=(), metavar="CATEGORY", help="such as wooden_cabinet")
    add(
        "--goal",
        nargs="+",
        default=(),
        metavar="ATOM",
        help="such as 'On red_coffee_mug_1 plate_1' (default: first on last)",
    )
    add("--language", help="the instruction (default: it describes the goal)")
    add("--out", type=arguments.path, default=Path(), help="folder (default: here)")
    add("--bddl", action="store_true", help="also write the BDDL file")
    new.set_defaults(run=run_new)


def _register_preview(commands: Subparsers) -> None:
    preview = commands.add_parser(
        "preview", help="pictures of a task's initial states, and a video of the expert"
    )
    add = preview.add_argument
    add("task", help="a file that ends in .yaml or .bddl, or such as libero_goal/3")
    add(
        "--starts",
        type=arguments.whole(1, 50),
        default=3,
        help="number of initial states, one per row (default: 3)",
    )
    add("--cameras", nargs="+", help="one per column (default: agentview robot0_eye_in_hand birdview)")
    add("--size", type=arguments.side, default=256, help="pixels of a picture (default: 256)")
    add(
        "--video",
        nargs="?",
        const="webp",
        choices=("webp", "gif", "mp4"),
        help="also write a video of the expert (default format: webp)",
    )
    add(
        "--out",
        type=arguments.path,
        help="file of the pictures (default: TASK.png here); the video is written beside it",
    )
    preview.set_defaults(run=run_preview)


def run_new(args: argparse.Namespace) -> None:
    """Write the file and print commands for the next steps.

    Raises:
        LiberoError: A name does not exist or is none, or the file exists already.
    """
    from libero_env.design.template import task_template
    from libero_env.errors import LiberoError
    from libero_env.tasks import read_task
    from libero_env.tasks.files import write_task
    from libero_env.tasks.task import check_name

    if args.name.startswith(".") or Path(args.name).name != args.name:
        raise LiberoError(f"{args.name!r} is not the name of a task, such as my_task; --out is the folder")
    check_name(args.name)
    path = args.out / f"{args.name}.yaml"
    if path.exists():
        raise LiberoError(f"{path} exists already; choose another name, or remove it")
    text, _ = task_template(args.scene, args.objects, args.furniture, args.goal, args.language)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    task = read_task(path)
    print(f"{path}: {task.language}")
    if args.bddl:
        print(write_task(task, path.with_suffix(".bddl")))
    for command in (
        f"libero tasks preview {path} --video",
        f"libero tasks lint {path}",
        f"libero demos generate --task {path} --n 10",
        f"python train.py benchmark=own benchmark.files='[{path}]' language=onehot",
    ):
        print(f"  {command}")


def run_preview(args: argparse.Namespace) -> int:
    """Render, and print the paths of the files; return 1 if the expert does not reach the goal."""
    from libero_env.design.preview import CAMERAS, contact_sheet, expert_video
    from libero_env.tasks import get_task

    task = get_task(args.task)
    out = args.out or Path(f"{task.name}.png")
    print(contact_sheet(task, out, starts=args.starts, cameras=args.cameras or CAMERAS, size=args.size))
    if not args.video:
        return 0
    video = out.with_suffix(f".{args.video}")
    done, reason = expert_video(task, video, size=args.size)
    print(f"{video}: the expert {'reaches the goal' if done else f'does not reach the goal: {reason}'}")
    return int(not done)
