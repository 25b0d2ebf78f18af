"""`libero tasks certify` and `libero tasks lint`: whether tasks can be done, and whether they are well designed."""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lifelong import cli_tasks_new

if TYPE_CHECKING:
    from libero_env.certify import Certificate
    from libero_env.lint_report import Finding
    from libero_env.tasks import Task


LEVELS = ("error", "warning", "info")


def register(commands: "argparse._SubParsersAction") -> None:
    """`libero tasks certify|lint|new|preview`, next to the other commands about tasks"""
    cli_tasks_new.register(commands)
    certify = commands.add_parser("certify", help="let the expert try tasks; goes on where it was stopped")
    _add_tasks(certify)
    certify.add_argument(
        "--states", type=_states, default=50, help="starts of each task, 1 to 50 (default: 50)"
    )
    certify.add_argument("--jobs", type=int, default=0, help="processes (default: one for each core)")
    certify.add_argument(
        "--out", type=Path, default=Path("certificates"), help="folder (default: certificates)"
    )
    certify.add_argument(
        "--require", type=float, default=0.8, help="share of success each task needs (default: 0.8)"
    )
    certify.add_argument("--disturb", action="store_true", help="disturb the actions as demonstrations do")
    certify.add_argument("--again", action="store_true", help="run what is in the folder too")
    certify.set_defaults(run=run_certify)
    lint = commands.add_parser(
        "lint", help="what is wrong or doubtful in the design of tasks, and how to mend it"
    )
    _add_tasks(lint)
    lint.add_argument(
        "--level", choices=LEVELS, default="warning", help="the least that is told (default: warning)"
    )
    lint.add_argument(
        "--starts", type=int, default=5, help="starts to look at; 0 simulates nothing (default: 5)"
    )
    lint.set_defaults(run=run_lint)


def _add_tasks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "tasks",
        nargs="+",
        metavar="TASK",
        help="such as libero_goal/3, a suite, or a file that ends in .bddl or .yaml",
    )
    parser.add_argument("--assets", help="`builtin`, or the folder of the original's models")


def _states(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 50:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to 50")
    return value


def find_tasks(names: Sequence[str]) -> list["Task"]:
    """The tasks that are meant, each once: suites, tasks of suites, and task files.

    Raises:
        LiberoError: no such suite, task or file, or a file that is no task.
    """
    from libero_env.tasks import get_suite, get_task, suite_names
    from libero_env.tasks.files import read_yaml_tasks

    found: dict[tuple[str, str], Task] = {}
    for name in names:
        if name.endswith((".yaml", ".yml")):
            tasks: Sequence[Task] = read_yaml_tasks(name)
        else:
            tasks = get_suite(name).tasks if name in suite_names() else (get_task(name),)
        found |= {(name if task.suite == "file" else task.suite, task.name): task for task in tasks}
    return list(found.values())


def run_certify(args: argparse.Namespace) -> int:
    """Run what is missing, write the results and say which tasks fall short; 1 where one does."""
    from libero_env.certify import certify
    from libero_env.demos_generate import cores

    jobs = args.jobs or cores()
    found = certify(
        find_tasks(args.tasks),
        args.states,
        jobs=jobs,
        out=args.out,
        assets=args.assets,
        disturb=args.disturb,
        again=args.again,
    )
    write_results(found, args.out, assets=args.assets, disturb=args.disturb)
    short = [certificate for certificate in found if certificate.rate < args.require]
    for certificate in short:
        reason = next((o.reason for o in certificate.outcomes if not o.success), "")
        print(
            f"FAIL  {certificate.task} {certificate.name}: {100 * certificate.rate:.0f} %, such as: {reason}"
        )
    good, total = sum(len(c.lengths) for c in found), sum(len(c.outcomes) for c in found)
    print(
        f"{good}/{total} = {100 * good / total:.1f} %; {len(short)} of {len(found)} tasks under {args.require:.0%}"
    )
    return int(bool(short))


def write_results(
    certificates: Sequence["Certificate"], out: Path, *, assets: str | None = None, disturb: bool = False
) -> None:
    """`results.json`, `results.md` and, where matplotlib is installed, a picture for each suite; says what it wrote."""
    from libero_env.certify import markdown_table, results

    out.mkdir(parents=True, exist_ok=True)
    ending = "-disturbed" if disturb else ""
    written = [out / f"results{ending}.json", out / f"results{ending}.md"]
    written[0].write_text(json.dumps(results(certificates, assets=assets, disturb=disturb), indent=1) + "\n")
    written[1].write_text(markdown_table(certificates))
    suites: dict[str, list[Certificate]] = {}
    for certificate in certificates:
        suites.setdefault(certificate.task.partition("/")[0], []).append(certificate)
    for suite, own in suites.items():
        path = out / f"{suite}{ending}.png"
        try:
            draw(own, path, f"{suite}: steps of the expert from each start")
        except ModuleNotFoundError as error:
            print(f"no picture of {suite}: {error.name} is not installed (it is in the extra `train`)")
        else:
            written.append(path)
    print("\n".join(map(str, written)))


def draw(certificates: Sequence["Certificate"], path: Path, title: str) -> None:
    """A picture of a suite: a row for each task, a column for each start, coloured by length; failures red.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from lifelong.figures import success_colours

    states = max(len(c.outcomes) for c in certificates)
    steps = np.full((len(certificates), states), np.nan)
    for row, certificate in zip(steps, certificates, strict=True):
        row[: len(certificate.outcomes)] = [o.steps if o.success else np.nan for o in certificate.outcomes]
    figure = Figure(figsize=(8.5, 1.2 + 0.2 * len(certificates)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = success_colours().with_extremes(bad="#b03024")
    image = axes.imshow(
        np.ma.masked_invalid(steps), cmap=colours, aspect="auto", interpolation="nearest", vmin=0
    )
    labels = [f"{_label(c)}  {100 * c.rate:.0f} %" for c in certificates]
    axes.set_yticks(range(len(labels)), labels, fontsize=6)
    axes.set_xlabel("initial state; red where the goal was not reached", fontsize=7)
    axes.tick_params(axis="x", labelsize=6)
    axes.set_title(title, fontsize=8)
    figure.colorbar(image, ax=axes, shrink=min(1.0, 20 / len(certificates))).ax.tick_params(labelsize=6)
    figure.savefig(path)


def _label(certificate: "Certificate") -> str:
    words = certificate.name.replace("_", " ")
    return f"{certificate.task.rpartition('/')[2]}  {words if len(words) <= 64 else words[:63] + '…'}"


def run_lint(args: argparse.Namespace) -> int:
    """One line for each finding, and how many there are; 1 where one is an error."""
    from collections import Counter

    counts, number = Counter[str](), 0
    for findings in _lint(args):
        number += 1
        counts.update(finding.level for finding in findings)
        for finding in findings:
            if LEVELS.index(finding.level) <= LEVELS.index(args.level):
                print(finding, flush=True)
    print(f"{number} tasks: {counts['error']} errors, {counts['warning']} warnings, {counts['info']} notes")
    return int(counts["error"] > 0)


def _lint(args: argparse.Namespace) -> "Iterator[list[Finding]]":
    """The findings of each task."""
    from libero_env.assets import select_pack
    from libero_env.lint import lint_file, lint_task, lint_text

    pack = select_pack(args.assets)
    for name in dict.fromkeys(args.tasks):
        if name.endswith(".bddl"):
            yield lint_file(name, pack, starts=args.starts)
            continue
        for task in find_tasks([name]):
            if task.suite == "file":  # lines count in what `libero tasks show` prints
                yield lint_text(task.bddl_text, name, task, pack, starts=args.starts)
            else:
                yield lint_task(task, pack, starts=args.starts)
