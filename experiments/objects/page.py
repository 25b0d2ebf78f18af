"""Writes docs/gallery.md: the images of the gallery in tables, objects by family and tasks by suite."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import yaml

from libero_env.objects import object_names
from libero_env.tasks import Task, get_suite, suite_names

FAMILIES = {
    "groceries": "Groceries",
    "kitchenware": "Kitchenware",
    "articulated": "Objects with doors, drawers and knobs",
    "furniture": "Books, trays and shelves",
    "": "Others",
}
FOLDER = Path("images/gallery")
OBJECT_COLUMNS, TASK_COLUMNS = 5, 4


def object_file(category: str) -> Path:
    """Picture of a category, relative to the docs."""
    return FOLDER / "objects" / f"{category}.jpg"


def task_file(task: Task) -> Path:
    """Picture of a task, relative to the docs."""
    return FOLDER / "tasks" / f"{task.suite}-{task.index}.jpg"


def write_page(docs: Path) -> None:
    """Write gallery.md into the folder of the docs."""
    parts = [
        "# Gallery",
        "Every object and every task with the builtin pack; `experiments/objects/gallery.py` draws this page. "
        "On one sheet: [objects](images/objects.png).",
        "## Objects",
    ]
    for family, names in families().items():
        parts += [f"### {FAMILIES[family]}", _table(OBJECT_COLUMNS, [_object_cell(name) for name in names])]
    parts += [
        "## Tasks",
        "The first initial state of each task as the camera `agentview` sees it, and the instruction. "
        "A task's id is its suite and number, such as `libero_goal/3`.",
    ]
    for suite in suite_names():
        own = [task for task in get_suite(suite).tasks if task.suite == suite]
        if own:
            parts += [f"### {suite}", _table(TASK_COLUMNS, [_task_cell(task) for task in own])]
    (docs / "gallery.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def families() -> dict[str, list[str]]:
    """Family -> its categories, sorted; those without parameters are of the family ''."""
    parameters = files("libero_env.objects.builtin") / "parameters"
    owner = {
        name: family
        for family in FAMILIES
        if family
        for name in yaml.safe_load((parameters / f"{family}.yaml").read_text(encoding="utf-8"))
    }
    names = object_names()
    return {family: [n for n in names if owner.get(n, "") == family] for family in FAMILIES}


def _object_cell(category: str) -> str:
    return f"{_image(object_file(category), category, 150)}<br>`{category}`"


def _task_cell(task: Task) -> str:
    return f"{_image(task_file(task), task.id, 190)}<br>{task.index}: {task.language}"


def _image(path: Path, name: str, width: int) -> str:
    """HTML, because Markdown has no widths and the tables must fit the page."""
    return f'<img src="{path.as_posix()}" alt="{name}" width="{width}">'


def _table(columns: int, cells: Sequence[str]) -> str:
    """A Markdown table; its first row of cells stands where the header would."""
    padded = [*cells, *[""] * (-len(cells) % columns)]
    rows = [f"| {' | '.join(padded[i : i + columns])} |" for i in range(0, len(padded), columns)]
    return "\n".join([rows[0], "|" + " :-: |" * columns, *rows[1:]])
