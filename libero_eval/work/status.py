"""What happens in the folder of an evaluation: for `libero eval --status`."""

from pathlib import Path

from libero_eval.evaluation_file import FILE_NAME
from libero_eval.work.folder import WorkFolder, read_plan, read_unit
from libero_eval.work.progress import measure_progress


def describe_status(path: Path) -> str:
    """Return how far an evaluation is, who works on which unit, and what went wrong, as text.

    Args:
        path: Folder of the evaluation.

    Raises:
        LifelongError: The folder holds no evaluation, or a broken file.
    """
    plan = read_plan(path)
    folder = WorkFolder(path, plan)
    files = {name: path / "units" / f"{name}.json" for name in plan["units"]}
    done = {name: read_unit(file)[0] for name, file in files.items() if file.is_file()}
    held, errors = folder.held(), folder.errors()
    lines = [
        f"policy    {', '.join(f'{k} {v}' for k, v in plan['evaluated'].items())}",
        f"progress  {measure_progress(plan['units'], done, len(held), len(errors))}",
    ]
    for name, claim in sorted(held.items()):
        who = claim.claim.holder if claim.claim else "a process that is starting"
        lines.append(f"running   {name} by {who}, seen {max(0.0, claim.silent):.0f} s ago")
    for name, found in errors.items():
        lines.append(f"error     {name}, {found.attempts} attempts: {found.last}; see {found.path}")
    if len(done) == len(files):
        lines.append(f"result    {path / FILE_NAME}")
    elif not held:
        lines.append("stopped   no process works on it; the same command goes on")
    return "\n".join(lines)
