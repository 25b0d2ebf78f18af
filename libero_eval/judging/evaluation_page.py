"""The page of one evaluation: success on each task with its interval, and the recorded episodes that failed."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from libero_env.text import flatten
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult, TaskResult, overall
from libero_eval.judging.comparability import facts
from libero_eval.judging.page import interval_text
from libero_eval.repeating import again
from libero_eval.work.store import PAGE_NAME
from lifelong.report.media import media
from lifelong.report.tables import save_page
from lifelong.results.failures import causes_text, safety_text


def write_evaluation_page(result: EvaluationResult, folder: Path) -> Path:
    """Write the page beside the result's file; it needs no other file and no network.

    Raises:
        ResultsError: The page cannot be written.
    """
    suites, labels = result.by_suite, result.suite_labels
    means = {"mean over tasks": result.tasks, **(suites if len(suites) > 1 else {})}
    return save_page(
        folder / PAGE_NAME,
        "libero_eval.judging",
        "evaluation.html",
        title=f"{name_of(result)} on {', '.join(labels.values())}",
        facts=facts(result),
        notes=[f"{task.task}: {task.error_note}" for task in result.tasks if task.error_note]
        + ([f"{result.stop_note}. The intervals are always valid."] if result.stopped else []),
        means=[
            _row(labels.get(name, name), tasks) | {"success": result.suites.get(name, result.success)}
            for name, tasks in means.items()
        ],
        tasks=[
            _row(task.task, [task], task.instruction) | {"success": result.success_of([task])}
            for task in result.tasks
        ],
        media=media(folder / "videos", "*_failure.*"),
        command=again(result, os.path.relpath(folder / FILE_NAME)),
        versions={**flatten(result.versions), **flatten(result.environment)},
        interval_text=interval_text,
    )


def name_of(result: EvaluationResult) -> str:
    """Return the name of the policy: what its user called it, or the word that it was evaluated by."""
    return str(result.evaluated.get("name") or result.policy or "policy")


def _row(name: str, tasks: Sequence[TaskResult], text: str = "") -> dict[str, Any]:
    errors, causes = [error for task in tasks for error in task.errors if error], causes_text(tasks)
    notes = [f"failed because {causes}"] if causes else []
    notes += [safety] if (safety := safety_text(tasks)) else []
    if text:  # of one task
        notes += filter(None, (tasks[0].event_note, tasks[0].clock_note))
        notes += [f"{len(errors)} ended with an error, such as: {errors[0]}"] if errors else []
    return {
        "name": name,
        "text": text,
        "wins": sum(sum(task.successes) for task in tasks),
        "episodes": sum(len(task.successes) for task in tasks),
        "success": overall(tasks),
        "notes": notes,
    }
