"""`libero demos`: record demonstrations, say what there is, check files."""

import argparse
from pathlib import Path


def register(subparsers: "argparse._SubParsersAction") -> None:
    """`libero demos generate|info|check`"""
    parser = subparsers.add_parser("demos", help="record demonstrations, list and check them")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _register_generate(commands)
    info = commands.add_parser("info", help="the demonstration files in a folder")
    info.add_argument(
        "paths", nargs="*", type=Path, help="files or folders (default: where demonstrations are kept)"
    )
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="read demonstrations whole and say what is broken")
    check.add_argument(
        "paths", nargs="*", type=Path, help="files or folders (default: where demonstrations are kept)"
    )
    check.set_defaults(run=run_check)


def _register_generate(commands: "argparse._SubParsersAction") -> None:
    generate = commands.add_parser(
        "generate", help="record with the scripted expert; goes on where it was stopped"
    )
    what = generate.add_mutually_exclusive_group(required=True)
    what.add_argument("--benchmark", "--suite", help="all tasks of a suite, such as libero_object")
    what.add_argument("--task", help="one task, such as libero_object/3")
    generate.add_argument("--n", type=positive, default=50, help="demonstrations of each task (default: 50)")
    generate.add_argument(
        "--size", type=positive, default=128, help="height and width of the pictures (default: 128)"
    )
    generate.add_argument("--seed", type=int, default=0, help="of starts and manners (default: 0)")
    generate.add_argument("--workers", type=int, default=0, help="processes (default: one for each core)")
    generate.add_argument(
        "--folder", type=Path, help="where to keep them (default: LIBERO_DEMOS, or in the cache)"
    )
    generate.set_defaults(run=run_generate)


def positive(text: str) -> int:
    """An integer of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return value


def run_generate(args: argparse.Namespace) -> None:
    """Record what is missing, then list the files."""
    from libero_env.demos_generate import ensure_demos
    from libero_env.tasks import get_suite, get_task

    tasks = get_suite(args.benchmark).tasks if args.benchmark else (get_task(args.task),)
    size = (args.size, args.size)
    paths = ensure_demos(
        tasks, args.n, camera_size=size, seed=args.seed, root=args.folder, workers=args.workers
    )
    for path in paths:
        print(describe(path))


def run_info(args: argparse.Namespace) -> None:
    """One line for each file."""
    for path in find_files(args.paths):
        print(describe(path))


def run_check(args: argparse.Namespace) -> int:
    """Read every file whole; 1 where one is broken."""
    from libero_env.demos import read_demos
    from libero_env.errors import DemoError

    broken = 0
    for path in find_files(args.paths):
        try:
            print(f"ok    {path}: {len(read_demos(path))} demonstrations")
        except DemoError as error:
            broken += 1
            print(f"FAIL  {error}")
    return int(broken > 0)


def find_files(paths: list[Path]) -> list[Path]:
    """The demonstration files that the paths name or hold.

    Raises:
        DemoError: there is none.
    """
    from libero_env.errors import DemoError
    from libero_env.paths import demos_dir

    paths = paths or [demos_dir()]
    found = [[path] if path.suffix == ".hdf5" else sorted(path.rglob("*.hdf5")) for path in paths]
    files = [file for group in found for file in group]
    if not files:
        where = ", ".join(map(str, paths))
        raise DemoError(
            f"no demonstrations in {where}; record some with `libero demos generate --benchmark NAME`"
        )
    return files


def describe(path: Path) -> str:
    """How many demonstrations a file holds, their steps and pictures, and how many attempts failed.

    Raises:
        DemoError: it is not a demonstration file.
    """
    from libero_env.demos import demo_names, opened
    from libero_env.doctor import show_bytes
    from libero_env.errors import DemoError

    if not path.is_file():
        raise DemoError(f"{path}: no such file")
    with opened(path) as handle:
        names = demo_names(handle, path)
        data = handle["data"]
        steps = [int(data[name].attrs.get("num_samples", 0)) for name in names]
        picture = data[names[0]].get("obs/agentview_rgb") if names else None
        size = "no pictures" if picture is None else "{}x{} pixels".format(*picture.shape[1:3])
        failed = data.attrs.get("num_failed_attempts", "unknown")
    parts = (f"{len(names)} demonstrations", f"{sum(steps)} steps", size, f"failed attempts: {failed}")
    return f"{path}: {', '.join(parts)}, {show_bytes(path.stat().st_size)}"
