"""`libero eval`: the success of a policy."""

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from libero_env.cli.options import FilePath
from libero_eval.requests import EvalRequest

if TYPE_CHECKING:
    from libero_eval.evaluation_file import TaskResult


@dataclass(frozen=True, kw_only=True)
class EvalOptions(EvalRequest):
    """Measure the success of a policy on tasks; a result, eval.json, as the policy is run again.

    Any number of processes may share a folder; each may be killed, and the same command goes on.

    Attributes:
        status: Only say how far the evaluation in this folder is.
    """

    status: FilePath | None = None


def evaluate(options: EvalOptions) -> None:
    """Evaluate a policy; print a row for each task, the mean, and the file of the results."""
    from libero_eval.evaluation_file import FILE_NAME
    from libero_eval.plan import plan_evaluation, run
    from libero_eval.work.progress import HEADER, describe_status, table_row, total_rows

    if options.status:
        print(describe_status(options.status))
        return
    evaluation = plan_evaluation(options)
    heads = [HEADER]

    def print_row(result: "TaskResult") -> None:
        print(*heads, table_row(result), sep="\n", flush=True)
        heads.clear()

    result = run(evaluation, options, on_task=print_row, on_progress=_print_progress)
    print(*total_rows(result.tasks), evaluation.out / FILE_NAME, sep="\n")
    for name in ("renderer", "instruction_set"):
        if isinstance(values := result.environment.get(name), list):
            listed = ", ".join(map(str, values))
            print(f"the processes differ in {name} ({listed}): bits may too", file=sys.stderr)


def _print_progress(progress: object) -> None:
    from tqdm import tqdm

    tqdm.write(str(progress), file=sys.stderr)  # above the bar of a terminal
