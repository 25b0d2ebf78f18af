"""`libero report`: a page about runs."""

from pathlib import Path
from typing import Annotated

from libero_env.cli.options import Field, FilePath, Positional
from lifelong.errors import ConfigError

RECORDS = "results.jsonl"  # in the directory of each run


def report(
    run_dirs: Positional[Annotated[tuple[FilePath, ...], Field(min_length=1)]],
    *,
    out: FilePath | None = None,
    reference: tuple[str, ...] = (),
    all_pairs: bool = False,
    margin: Annotated[float, Field(gt=0, lt=1)] = 0.05,
) -> None:
    """Write a page about one run, or about several side by side; print which of several differ significantly.

    Args:
        run_dirs: Directories of runs, such as runs/libero_object/ewc/...
        out: The page, or a folder for it (default: report.html in the run directory; for several, comparison/ here).
        reference: Methods that each other one is compared with, such as er; two methods are compared in any case.
        all_pairs: Compare every method with every other.
        margin: Difference in success from which on two methods are not equivalent.
    """
    from lifelong.report.page import comparison_text, shift_text, write_report

    for folder in run_dirs:
        _check_run(folder)
    page = write_report(list(run_dirs), out, references=reference, all_pairs=all_pairs, margin=margin)
    print(page)
    for line in comparison_text(page) if len(run_dirs) > 1 else shift_text(run_dirs[0]):
        print(line)


def _check_run(folder: Path) -> None:
    """Check that a folder is not one of runs, at some level below `runs`.

    Raises:
        ConfigError: It is; the message names its runs.
    """
    if (folder / RECORDS).is_file():
        return
    for levels in ("*", "*/*", "*/*/*"):
        if count := len(list(folder.glob(f"{levels}/{RECORDS}"))):
            shown = folder / levels
            raise ConfigError(
                f"{folder} is not a run: it holds {count}, in {shown}; write libero report {shown}"
            )
