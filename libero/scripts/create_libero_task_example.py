"""Write two user-defined tasks on a scene of the benchmark as task files, as an example."""

import argparse

from libero.libero.utils.task_generation_utils import TaskInfoTuple, generate_bddl_from_task_info
from libero.scripts.command import option, script

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


@script(option("--folder", default="custom_pddl", help="folder of the files (default: custom_pddl)"))
def main(args: argparse.Namespace) -> None:
    """Write the files and print their paths."""
    for task in TASKS:
        print(generate_bddl_from_task_info(task, output_dir=args.folder))
