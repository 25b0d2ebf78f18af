"""`libero eval` and `libero robustness`: the success of a policy, and what perturbations do to it."""

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli.ending import NOT_BEGUN, told_if_interrupted
from libero_env.cli.options import Answer, FilePath
from libero_env.storage import read_json
from libero_eval.cli.compare import named
from libero_eval.requests import EvalRequest, RobustnessRequest
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.evaluation_file import EvaluationResult, TaskResult
    from libero_eval.robustness.results import Robustness
    from lifelong.stats.intervals import Estimate


@dataclass(frozen=True, kw_only=True)
class EvalOptions(EvalRequest):
    """Measure the success of a policy on tasks; a result, eval.json, as the policy is run again.

    Any number of processes may share a folder; each may be killed, and the same command goes on.

    Attributes:
        status: Only say how far the evaluation in this folder is.
    """

    status: FilePath | None = None


def evaluate(options: EvalOptions) -> Answer:
    """Evaluate a policy; print a row for each task, the mean, the file of the results, and their page."""
    with told_if_interrupted(NOT_BEGUN):
        from libero_eval.words import check_words

        if not options.status:
            check_words(options)
        from libero_env.progress import tell_progress
        from libero_eval.evaluation_file import FILE_NAME
        from libero_eval.judging.evaluation_page import write_evaluation_page
        from libero_eval.plan import evaluate as run
        from libero_eval.plan import plan_evaluation
        from libero_eval.work.progress import HEADER, describe_status, table_row, total_rows

        if options.status:
            text, progress = describe_status(options.status)
            return Answer(text, {**asdict(progress), "seconds_left": progress.seconds_left})
        evaluation = plan_evaluation(options)
    heads = [HEADER]

    def print_row(result: "TaskResult", success: "Estimate | None" = None) -> None:
        print(*heads, table_row(result, success), sep="\n", flush=True)
        heads.clear()

    early = evaluation.until is not None  # rows are known at the end only
    on_task = (lambda _: None) if early else print_row
    result = run(options, evaluation, on_task=on_task, on_progress=lambda now: tell_progress(str(now)))
    for task in result.tasks if early else ():
        print_row(task, result.success_of([task]))
    for name in ("renderer", "instruction_set"):
        if isinstance(values := result.environment.get(name), list):
            listed = ", ".join(map(str, values))
            print(f"the processes differ in {name} ({listed}): bits may too", file=sys.stderr)
    file = evaluation.out / FILE_NAME
    print(*total_rows(result), file, sep="\n")
    data = {
        "success": result.success,
        "suites": result.suites,
        "tasks": {task.task: result.success_of([task]) for task in result.tasks},
        "episodes": {task.task: len(task.successes) for task in result.tasks},
        "stopped": result.stopped and asdict(result.stopped),
        "result": file,
    }
    return Answer("", data, write_evaluation_page(result, evaluation.out))


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(RobustnessRequest):
    """Evaluate a policy under every kind of perturbation at several severities.

    Each episode starts as one without perturbation does. Writes a page: success against severity with intervals, the
    area under it, the severity at which half is lost, and what two perturbations take together. It can be stopped; the
    same command goes on. Examples:

    libero robustness runs/libero_goal/er/bc_transformer_small_seed1 --workers 2

    libero robustness expert --suite libero_goal --out eval/expert: what can be done at all

    libero robustness my_policy:make --suite libero_goal --kinds camera light --beside expert=eval/expert

    libero robustness --report er=eval/er sequential=eval/sequential: only the page, of what is there

    Attributes:
        beside: Other policies' folders, NAME=DIR, which are drawn beside it.
        report: Only write the page of the first folder, NAME=DIR, with the others beside it; of other options, --out.
    """

    beside: tuple[str, ...] = ()
    report: tuple[str, ...] = ()


def robustness(options: RobustnessOptions) -> Answer:
    """Evaluate all conditions, print the table, and write the page."""
    from libero_eval.words import check_words

    if not options.report:
        check_words(options)
    from libero_eval.robustness.study import conditions_of, read_study, study_robustness

    if options.report:
        given = [f.name for f in fields(options) if getattr(options, f.name) != f.default]
        if useless := [name for name in given if name not in ("report", "out")]:
            names = ", ".join(n if n == "policy" else f"--{n.replace('_', '-')}" for n in useless)
            raise ConfigError(f"--report only writes the page of what is there; leave out {names}")
        folder = options.out or Path(named(options.report[0])[1])
        return _finish([_read(word) for word in options.report], folder)
    beside = [_read(word) for word in options.beside]  # before hours of work
    _check_labels([options.name or options.policy_name, *(policy.label for policy in beside)])
    name, folder = study_robustness(options, _print_condition)
    own = read_study(folder, options.name or name, conditions_of(options))
    return _finish([own, *beside], folder)


def _print_condition(condition: str, result: "EvaluationResult", done: int, count: int) -> None:
    from libero_eval.judging.page import interval_text

    e, name = result.success, condition or "without perturbations"
    line = f"{time.strftime('%H:%M')} {done:>3}/{count}  {name:<28} {100 * e.value:5.1f} % {interval_text(e)}"
    print(line.rstrip(), flush=True)


def _read(word: str) -> "Robustness":
    """Return the outcomes in a folder of this command, NAME=DIR or DIR."""
    from libero_eval.robustness.study import read_study

    name, folder = named(word)
    return read_study(Path(folder), name or "")


def _check_labels(labels: "Sequence[str]") -> None:
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise ConfigError(f"two policies are named {twice[0]}; give each a name of its own, NAME=DIR")


def _finish(policies: "Sequence[Robustness]", folder: Path) -> Answer:
    """Return the table of the first policy, and write the page."""
    from libero_eval.robustness.page import render, write_robustness
    from libero_eval.robustness.results import differences

    _check_labels([policy.label for policy in policies])
    for line in differences(policies):
        print(f"note: {line}", file=sys.stderr)
    page = write_robustness(policies, folder)
    return Answer(f"\n{render(policies[0])}\n", read_json(page.with_suffix(".json")), page)
