"""Evaluations that several processes carry out: one of a policy, or those of all conditions of a study."""

import io
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

from libero_env.cli import ending
from libero_env.memory import require_memory
from libero_env.text import counted
from libero_eval.evaluation_file import EvaluationResult, TaskResult
from libero_eval.requests import Request
from libero_eval.work.evaluation import Evaluation, iso_time
from libero_eval.work.progress import Progress
from libero_eval.work.worker import Worker, Workers

Evaluations = Mapping[str, Evaluation]  # by the name of the condition; a single one has none
Plan = Callable[[Any], Evaluations]
Told = Callable[[str, EvaluationResult, int, int], None]


def carry_out(
    plan: Plan,
    request: Request,
    evaluations: Evaluations,
    *,
    on_task: Callable[[TaskResult], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
    on_done: Told = lambda *_: None,
) -> dict[str, EvaluationResult]:
    """Run evaluations with the processes that a request asks for; what is done already is not run again.

    Args:
        plan: Function of a module that returns the evaluations of a request; further processes call it.
        request: What is asked for, with the folder of the results.
        evaluations: What `plan` returned here.
        on_task: Function called with the result of each task as soon as it is known.
        on_progress: Function called with the progress of all processes every half minute, and at the end.
        on_done: Function called with each evaluation's name, its result, and how many are done of how many.

    Raises:
        LiberoError: There is too little memory, or a folder holds another evaluation.
        EvaluationIncompleteError: Episodes ended with errors; the others are kept.
    """
    count = min(request.workers, sum(len(one.units) for one in evaluations.values()))
    remedy = "fewer --workers, --unit-starts or --videos, or a smaller --size"
    most = max(one.memory(count) for one in evaluations.values())
    require_memory(most, f"an evaluation by {counted(count, 'process')}", remedy)
    folder = request.out or next(iter(evaluations.values())).out
    with ending.told_if_interrupted(f"{folder} keeps what is done; the same command goes on"):
        if request.again:
            for evaluation in evaluations.values():
                evaluation.store.clear()
        finished = [_begin(evaluation) for evaluation in evaluations.values()]
        if all(finished):
            count = 1
            print(
                f"note: {folder}: finished {max(finished)}, nothing was run; --again repeats it",
                file=sys.stderr,
            )
        argument = (plan, replace(request, again=False))
        with Workers(count - 1, _help, argument) as workers:
            return _work(evaluations, workers.supervise, on_task, on_progress, on_done)


def _begin(evaluation: Evaluation) -> str:
    """Begin an evaluation or join it, with notes on what is done; return when it was finished, or nothing."""
    store, units = evaluation.store, evaluation.units
    store.join(units)
    done = store.done(units)
    here = str(evaluation.versions.get("source"))
    notes = []
    if others := sorted({str(one.versions.get("source")) for one in done.values()} - {here}):
        notes.append(
            f"units that are done are of another source of this package ({', '.join(others)}; here {here}), as the "
            "result will say; --again repeats them"
        )
    if any(unit.name in done and not evaluation.is_filmed(unit) for unit in units):
        notes.append("some of the episodes to be filmed are done, and are not filmed; --again repeats them")
    for note in notes:
        print(f"note: {store.path}: {note}", file=sys.stderr)
    finished = evaluation.starts_needed(done) is not None
    return iso_time(max(one.finished for one in done.values())) if finished else ""


def _work(
    evaluations: Evaluations,
    supervise: Callable[[int], None] = lambda _: None,
    on_task: Callable[[TaskResult], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
    on_done: Told = lambda *_: None,
) -> dict[str, EvaluationResult]:
    """Take units of all evaluations until none is free, and then wait for those of others."""
    results: dict[str, EvaluationResult] = {}
    for wait in (False, True) if len(evaluations) > 1 else (True,):
        for name, evaluation in evaluations.items():
            if name in results:
                continue

            def look(done: int, before: int = sum(len(evaluations[one].units) for one in results)) -> None:
                supervise(before + done)

            worker = Worker(evaluation, on_result=on_task, on_progress=on_progress, on_wait=look)
            with policy_threads(evaluation):
                result = worker.run(wait=wait)
            if result is not None:
                results[name] = result
                on_done(name, result, len(results), len(evaluations))
    return results


def _help(argument: tuple[Plan, Request]) -> None:
    """Work on the evaluations of another process, which prints them; an error ends this process with one line."""
    plan, request = argument
    with suppress(KeyboardInterrupt), ending.interruptible():
        try:
            with redirect_stderr(io.StringIO()):  # the other process says the same
                evaluations = plan(request)
            _work(evaluations)
        except Exception as error:  # noqa: BLE001 - told by kind
            sys.exit(ending.report(error, who="a worker ended: "))


@contextmanager
def policy_threads(evaluation: Evaluation) -> Iterator[None]:
    """Give PyTorch the number of threads that the evaluation names; their number changes the bits of a policy."""
    if find_spec("torch") is None:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(evaluation.policy_threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
