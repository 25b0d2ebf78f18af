"""`libero robustness`: what perturbations do to a policy, kind by kind and severity by severity."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from libero_eval.requests import RobustnessRequest

if TYPE_CHECKING:
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.robustness.results import Robustness


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(RobustnessRequest):
    """Evaluate a policy under every kind of perturbation at several severities.

    Each episode starts as one without perturbation does. Writes a page: success against severity with intervals, the
    area under it, the severity at which half is lost, and what two perturbations take together. It can be stopped; the
    same command goes on. Examples:

    libero robustness runs/libero_goal/er/bc_mlp_small_seed1 --workers 2

    libero robustness expert --suite libero_goal --out eval/expert: what can be done at all

    libero robustness my_policy:make --suite libero_goal --kinds camera light --beside expert=eval/expert

    libero robustness --report er=eval/er sequential=eval/sequential: only the page, of what is there

    Attributes:
        name: Name of the policy on the page (default: what names it).
        beside: Other policies' folders, NAME=DIR, which are drawn beside it.
        report: Only write the page of the first folder, NAME=DIR, with the others beside it.
    """

    name: str | None = None
    beside: tuple[str, ...] = ()
    report: tuple[str, ...] = ()


def robustness(options: RobustnessOptions) -> None:
    """Evaluate all conditions, print the table, and write the page."""
    from libero_eval.robustness.study import study_robustness

    if options.report:
        folder = options.out or Path(options.report[0].rpartition("=")[2])
        return _finish([_read(word) for word in options.report], folder)
    beside = [_read(word) for word in options.beside]  # before hours of work
    name, folder = study_robustness(options, _print_condition)
    _finish([_read(f"{options.name or name}={folder}"), *beside], folder)


def _print_condition(condition: str, result: "EvaluationResult", done: int, count: int) -> None:
    e = result.success
    print(
        f"{time.strftime('%H:%M')} {done:>3}/{count}  {condition or 'without perturbations':<28} "
        f"{100 * e.value:5.1f} % [{100 * e.low:.1f}, {100 * e.high:.1f}]",
        flush=True,
    )


def _read(word: str) -> "Robustness":
    """Return the outcomes in a folder of this command, NAME=DIR or DIR."""
    from libero_eval.robustness.study import read_study

    name, _, folder = word.rpartition("=")
    return read_study(Path(folder), name)


def _finish(policies: "Sequence[Robustness]", folder: Path) -> None:
    """Print the table of the first policy, and write the page."""
    from libero_eval.robustness.page import render, write_robustness

    print(f"\n{render(policies[0])}\n")
    print(write_robustness(policies, folder))
