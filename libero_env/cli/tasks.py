"""`libero tasks`: list, show, certify, lint, create and preview tasks; make their initial states."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Literal

from libero_env.cli.options import (
    Answer,
    Field,
    FilePath,
    Natural,
    Positional,
    Processes,
    ProcessesOrAll,
    Share,
    Side,
    TaskName,
)
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.parallel import cpu_count
from libero_env.text import counted

if TYPE_CHECKING:
    from libero_env.design.lint.report import Finding


def list_tasks(suite: Positional[str | None] = None, *, order: Natural = 0) -> None:
    """Print a line for each task; of the variants that others have published, one for each suite unless it is named.

    Args:
        suite: Such as libero_object.
        order: One of the published sequences, 0 to 20.
    """
    from libero_env.published import PublishedTask, published_sizes
    from libero_env.tasks import get_suite, suite_names

    names = [suite] if suite else suite_names()
    tasks = {task.id: task for name in names for task in get_suite(name).order(order)}
    for task in tasks.values():
        if isinstance(task, PublishedTask):
            print(f"{task.id:24} {task.kind:10} {task.language}  ({task.name})")
        else:
            print(f"{task.id:18} {task.language}")
    for name, size in {} if suite else published_sizes().items():
        print(f"{name:28} {size} variants: libero tasks list {name}")


def show(task: Positional[str]) -> None:
    """Print the BDDL of a task.

    Args:
        task: Such as libero_object/3, the task's name, or a task file.
    """
    from libero_env.tasks import get_task

    print(get_task(task).bddl_text, end="")


def init_states(
    suite: Positional[TaskName], *, out: FilePath | None = None, jobs: Processes | None = None
) -> None:
    """Generate the 50 stored initial states of a suite or task file again, and print the paths of the files.

    Args:
        suite: Such as libero_object, or a file that ends in .yaml or .bddl.
        out: Folder for the .npz files (default: those in the package; for a file, the cache).
        jobs: Number of processes (default: one per core).
    """
    from libero_env.init_states.store import cache_init_states, shipped_path, write_suite
    from libero_env.tasks import find_tasks, get_suite
    from libero_env.tasks.suites import ENDINGS, is_published

    if suite.endswith(ENDINGS) and not out:
        if jobs:
            raise InvalidInputError("--jobs cannot be used with a file without --out; leave it out")
        for task in find_tasks([suite]):
            print(cache_init_states(task))
        return
    if is_published(suite):
        raise InvalidInputError(
            f"{suite} starts from the states of the tasks that it varies, or from its own, made when they are needed; "
            "there is nothing to generate"
        )
    tasks = find_tasks([suite]) if suite.endswith(ENDINGS) else get_suite(suite).tasks
    for name in dict.fromkeys(task.suite for task in tasks):
        path = out / f"{name}.npz" if out else shipped_path(name)
        write_suite(path, [task for task in tasks if task.suite == name], jobs or cpu_count())
        print(path)


def certify_tasks(
    tasks: Positional[Annotated[tuple[TaskName, ...], Field(min_length=1)]],
    *,
    assets: str | None = None,
    states: Annotated[int, Field(ge=1, le=50)] = 50,
    jobs: ProcessesOrAll = 0,
    out: FilePath = Path("certificates"),
    require: Share = 0.8,
    disturb: bool = False,
    again: bool = False,
) -> Answer:
    """Measure the success of the expert, and print the tasks below the required rate; return 1 if there are any.

    What was measured before is not run again.

    Args:
        tasks: Such as libero_goal/3, a suite, or a file that ends in .bddl or .yaml.
        assets: builtin, original, or the folder of the original's models.
        states: Initial states of each task, 1 to 50.
        jobs: Number of processes; 0: one per core.
        out: Folder of the results.
        require: Success rate that each task must reach.
        disturb: Add noise to the actions, as demonstrations do.
        again: Run again what is in the folder.
    """
    from libero_env.design.certify import certify, write_results
    from libero_env.sim.history import over_time
    from libero_env.tasks import find_tasks

    found = find_tasks(tasks)
    how: dict[str, Any] = {"assets": assets, "disturb": disturb}
    certificates = certify(found, states, jobs=jobs or cpu_count(), out=out, again=again, **how)
    write_results(certificates, out, **how)
    short = [certificate for certificate in certificates if certificate.rate < require]
    lines = []
    for one in short:
        reason = next((o.reason for o in one.outcomes if not o.success), "")
        lines.append(f"FAIL  {one.task} {one.name}: {100 * one.rate:.0f} %, such as: {reason}")
    for task in found:
        if part := next(over_time(task.problem.goal), None):
            lines.append(f"note  {task.id} {task.name}: the original's reader refuses {part}")
    good, total = sum(len(c.lengths) for c in certificates), sum(len(c.outcomes) for c in certificates)
    lines.append(
        f"{good}/{total} = {100 * good / total:.1f} %; {len(short)} of {len(certificates)} tasks under {require:.0%}"
    )
    data = [{**c.summary(), "passed": c not in short} for c in certificates]
    return Answer("\n".join(lines), data, status=int(bool(short)))


def lint(
    tasks: Positional[Annotated[tuple[TaskName, ...], Field(min_length=1)]],
    *,
    assets: str | None = None,
    level: Literal["error", "warning", "info"] = "warning",
    starts: Annotated[int, Field(ge=0, le=1000)] = 5,
) -> Answer:
    """Report what is wrong or doubtful in tasks, and how to fix it; return 1 if one has an error.

    Args:
        tasks: Such as libero_goal/3, a suite, or a file that ends in .bddl or .yaml.
        assets: builtin, original, or the folder of the original's models.
        level: Lowest level that is printed, or in the JSON.
        starts: Initial states to check; 0 simulates nothing.
    """
    from libero_env.design.lint.report import LEVELS

    counts, shown, number = Counter[str](), list[dict[str, Any]](), 0
    for findings in _lint(tasks, assets, starts):
        number += 1
        for finding in findings:
            counts[finding.level] += 1
            if LEVELS.index(finding.level) <= LEVELS.index(level):
                shown.append(asdict(finding))
                print(finding, flush=True)
    words = {"error": "error", "warning": "warning", "info": "note"}
    text = ", ".join(counted(counts[level], word) for level, word in words.items())
    text = f"{counted(number, 'task')}: {text}"
    return Answer(text, shown, status=int(counts["error"] > 0))


def _lint(names: Sequence[str], assets: str | None, starts: int) -> "Iterator[list[Finding]]":
    """Yield the findings of each task; lines of a suite's are those that `libero tasks show` prints."""
    from libero_env.assets.pack import select_pack
    from libero_env.design.lint.checks import lint_file, lint_task, lint_yaml
    from libero_env.tasks import find_tasks

    pack, seen = select_pack(assets), set[str]()
    for name in dict.fromkeys(names):
        if name.endswith(".bddl"):
            yield lint_file(name, pack, starts=starts)
        elif name.endswith((".yaml", ".yml")):
            yield from lint_yaml(name, pack, starts=starts)
        else:
            tasks = {task.id: task for task in find_tasks([name]) if task.id not in seen}
            seen |= tasks.keys()
            yield from (lint_task(task, pack, starts=starts) for task in tasks.values())


def new(
    name: Positional[str],
    *,
    scene: str = "kitchen",
    objects: tuple[str, ...] = (),
    furniture: tuple[str, ...] = (),
    goal: tuple[str, ...] = (),
    language: str | None = None,
    out: FilePath = Path(),
    bddl: bool = False,
) -> None:
    """Write a template of a user-defined task, and print commands for the next steps.

    Args:
        name: Name of the task; the file is NAME.yaml.
        scene: kitchen, living_room, study, coffee, table, floor, or kitchen_scene1, ...
        objects: Categories, such as red_coffee_mug plate (default: bowl, plate).
        furniture: Categories, such as wooden_cabinet.
        goal: Atoms, such as 'On red_coffee_mug_1 plate_1' (default: first on last).
        language: The instruction (default: it describes the goal).
        out: Folder.
        bddl: Also write the BDDL file.
    """
    from libero_env.design.template import task_template
    from libero_env.tasks import read_task
    from libero_env.tasks.suites import write_task
    from libero_env.tasks.task import check_name

    if name.startswith(".") or Path(name).name != name:
        raise LiberoError(f"{name!r} is not the name of a task, such as my_task; --out is the folder")
    check_name(name)
    path, text_file = out / f"{name}.yaml", out / f"{name}.bddl"
    if present := [file for file in (path, *[text_file] * bddl) if file.exists()]:
        raise LiberoError(f"{present[0]} exists already; choose another name, or remove it")
    text, _ = task_template(scene, objects, furniture, goal, language)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    task = read_task(path)
    print(f"{path}: {task.language}")
    if bddl:
        print(f"{write_task(task, text_file)}: {task.language}")
    for command in (
        f"libero tasks preview {quote(str(path))} --video",
        f"libero tasks lint {quote(str(path))}",
        f"libero demos generate --task {quote(str(path))} --n 10 --for preset=laptop",
        f"python train.py benchmark=own benchmark.files='[{path}]' data.demos=10 language=onehot",
    ):
        print(f"  {command}")


def preview(
    task: Positional[TaskName],
    *,
    starts: Annotated[int, Field(ge=1, le=50)] = 3,
    cameras: tuple[str, ...] = (),
    size: Side = 256,
    video: Annotated[tuple[Literal["webp", "gif", "mp4"], ...] | None, Field(max_length=1)] = None,
    out: FilePath | None = None,
) -> int:
    """Render a task's initial states, and a video of the expert; return 1 if the expert does not reach the goal.

    Args:
        task: A file that ends in .yaml or .bddl, or such as libero_goal/3.
        starts: Number of initial states, one per row.
        cameras: One per column, as of `libero demos generate` (default: agentview robot0_eye_in_hand birdview, and
            the task's own).
        size: Side of a picture, pixels.
        video: Also write a video of the expert, by default as webp.
        out: File of the pictures (default: TASK.png here); the video is written beside it.
    """
    from libero_env.design.preview import contact_sheet, expert_video
    from libero_env.tasks import get_task

    chosen = get_task(task)
    path = out or Path(f"{chosen.name}.png")
    file = None if video is None else path.with_suffix(f".{(*video, 'webp')[0]}")
    if file == path:
        raise InvalidInputError(f"--out {path} would be both the pictures and the video; name a .png")
    print(contact_sheet(chosen, path, starts=starts, cameras=cameras, size=size))
    if file is None:
        return 0
    done, reason = expert_video(chosen, file, size=size)
    print(f"{file}: the expert {'reaches the goal' if done else f'does not reach the goal: {reason}'}")
    return int(not done)
