"""`libero perturb`: what can be perturbed, what it looks like, and whether the expert solves it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from libero_env.cli.options import (
    Answer,
    Field,
    FilePath,
    Positional,
    ProcessesOrAll,
    Seed,
    Side,
    TaskName,
    arg,
)
from libero_env.errors import InvalidInputError
from libero_env.parallel import cpu_count

Perturb = Annotated[str, arg(metavar="KIND=SEVERITY,...")]
Severities = Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)]


def list_kinds() -> None:
    """Print a line for each kind, with the unit and what severity 1 is, in the order in which they are applied."""
    from libero_env.perturbations import KINDS

    print(f"{'layer':12} {'kind':14} {'at 1':>5} {'unit':22} what changes")
    for kind in KINDS.values():
        print(f"{kind.layer:12} {kind.name:14} {kind.at_one:5g} {kind.unit:22} {kind.what}")


def show(
    task: Positional[TaskName],
    *,
    perturb: Perturb,
    seed: Seed = 0,
    start: Annotated[int, Field(ge=0, le=49)] = 0,
    size: Side = 256,
    out: FilePath = Path("perturbed.png"),
) -> None:
    """Write a picture of a start without and with perturbations, side by side; print instruction and amounts.

    Args:
        task: Such as libero_goal/3.
        perturb: Such as camera=0.3,light=0.5.
        seed: Seed of what is sampled.
        start: Initial state.
        size: Side of each picture, pixels.
        out: File of the picture.
    """
    from libero_env.perturbations import parse_perturbations
    from libero_env.tasks import get_task

    perturbations = parse_perturbations(perturb, seed)
    from libero_env.design.preview import compare_starts

    changed = compare_starts(get_task(task), perturbations, out, start=start, size=size)
    for perturbation in perturbations:
        print(f"{perturbation!s:22} {perturbation.amount:g} {perturbation.definition.unit}")
    print(f"{changed.language}\n{out}")


def certify(
    tasks: Positional[Annotated[tuple[TaskName, ...], Field(min_length=1)]],
    *,
    kinds: tuple[str, ...] = (),
    severities: Severities = (0.2, 0.4, 0.6, 0.8, 1.0),
    starts: Annotated[int, Field(ge=1, le=50)] = 10,
    redraws: Annotated[int, Field(ge=0, le=20)] = 3,
    seed: Seed = 0,
    jobs: ProcessesOrAll = 0,
    out: FilePath = Path("certificates/perturbed"),
    again: bool = False,
    keep: bool = False,
) -> Answer:
    """Measure whether the expert solves what is sampled, and sample again what it does not; resumes.

    Prints the share that the expert solves of each kind and severity.

    Args:
        tasks: Such as libero_goal/3, or a suite.
        kinds: Kinds (default: all that change physics, start or actions).
        severities: Severities of each kind, above 0.
        starts: Initial states of each task.
        redraws: Further samples after a failure.
        seed: Seed of what is sampled.
        jobs: Number of processes; 0: one per core.
        out: Folder of the results.
        again: Run again what is in the folder.
        keep: Let environments use the samples that were solved (writes to the package).
    """
    from libero_env.perturbations import KINDS, Perturbation
    from libero_env.perturbations.kinds import attempts_file
    from libero_env.storage import read_json, write_json
    from libero_env.tasks import find_tasks
    from libero_env.tasks.task import FILE

    found = find_tasks(tasks)
    if keep and (own := [task.name for task in found if task.suite == FILE]):
        raise InvalidInputError(
            f"--keep cannot be used with task files, such as that of {own[0]}: samples are kept by the id of a task, "
            "which all files share; leave it out"
        )
    names = kinds or [name for name, kind in KINDS.items() if kind.physical]
    amounts = dict.fromkeys(severities)
    perturbations = [Perturbation(kind, s, seed) for kind in dict.fromkeys(names) for s in amounts]
    from libero_env.design.certify_perturbed import certify_perturbed, shares_table

    certificates = certify_perturbed(
        found,
        perturbations,
        starts,
        redraws=redraws,
        jobs=jobs or cpu_count(),
        out=out,
        again=again,
    )
    lines = [*shares_table(certificates, perturbations)]
    if keep:
        named = {str(one): one for one in perturbations}
        solved = read_json(attempts_file())
        for certificate in certificates:
            solved |= certificate.attempts(named[certificate.perturbation])
        write_json(attempts_file(), {name: n for name, n in sorted(solved.items()) if n})
        lines.append(str(attempts_file()))
    return Answer("\n".join(lines), [asdict(one) for one in certificates])
