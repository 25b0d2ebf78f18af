"""An example of tasks of one's own: two on a scene of the benchmark, written as task files."""

import argparse
from collections.abc import Sequence

from libero.libero.utils.task_generation_utils import TaskInfoTuple, generate_bddl_from_task_info
from libero.scripts.command import run

TASKS = (
    TaskInfoTuple(
        "kitchen_scene1",
        "open the top drawer of the cabinet and put the bowl in it",
        ("wooden_cabinet_1", "akita_black_bowl_1"),
        (
            ("Open", "wooden_cabinet_1_top_region"),
            ("In", "akita_black_bowl_1", "wooden_cabinet_1_top_region"),
        ),
    ),
    TaskInfoTuple(
        "kitchen_scene1",
        "put the plate on top of the cabinet",
        ("plate_1", "wooden_cabinet_1"),
        (("On", "plate_1", "wooden_cabinet_1_top_side"),),
    ),
)


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="create_libero_task_example.py", description=__doc__)
    parser.add_argument("--folder", default="custom_pddl", help="for the files (default: custom_pddl)")
    return run(parser, create, argv)


def create(args: argparse.Namespace) -> None:
    """Write the files and name them."""
    for task in TASKS:
        print(generate_bddl_from_task_info(task, output_dir=args.folder))


if __name__ == "__main__":
    raise SystemExit(main())
