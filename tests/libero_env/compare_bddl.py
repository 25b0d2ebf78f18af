"""Compare the generated task files with the original ones.

    python tests/libero_env/compare_bddl.py [FOLDER]

FOLDER holds the original's `<suite>/<task>.bddl`. Prints what differs, task by task, and how many of the tasks
mean the same; the exit status is 1 where one does not.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

from libero_env.errors import LiberoError
from libero_env.tasks import Task, bddl, get_suite, suite_names
from libero_env.tasks.problem import differences

SHARED = Path(__file__).resolve().parents[3] / "shared"


def all_tasks() -> list[Task]:
    """Every task once, whatever number of suites has it."""
    return list({task.id: task for name in suite_names() for task in get_suite(name).tasks}.values())


def compare(folder: Path) -> Iterator[tuple[Task, list[str]]]:
    """Each task with its differences from the original, which is read from the text that we generate."""
    for task in all_tasks():
        file = folder / task.suite / f"{task.name}.bddl"
        try:
            original = bddl.read(file)
        except (OSError, LiberoError) as error:
            yield task, [str(error)]
            continue
        found = differences(original, bddl.parse(task.bddl_text, f"generated {task.id}"))
        if (
            original.obj_of_interest != task.problem.obj_of_interest
        ):  # their order shows in the drop-in facade
            found.append(f"obj_of_interest: {original.obj_of_interest} is not {task.problem.obj_of_interest}")
        yield task, found


def main(argv: list[str]) -> int:
    folder = Path(argv[0]) if argv else SHARED / "official" / "bddl_files"
    if not folder.is_dir():
        print(f"{folder} is no folder; give the one with the original's <suite>/<task>.bddl", file=sys.stderr)
        return 2
    same = total = 0
    for task, found in compare(folder):
        same, total = same + (not found), total + 1
        for line in found:
            print(f"{task.id} {task.name}\n    {line}")
    print(f"{same} of {total} mean the same")
    return int(same < total)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
