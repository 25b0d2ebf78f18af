"""Results of an evaluation in the formats of vla-eval, of LeRobot, and of the model cards of Hugging Face."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from libero_env.storage import atomic_write_text, own_folder, write_json
from libero_env.text import counted
from libero_eval.evaluation_file import EvaluationResult, TaskResult, suite_label
from libero_eval.judging.comparability import facts
from libero_eval.protocols.naming import protocol_label, section_of
from libero_eval.work.progress import PLUS
from lifelong.errors import ConfigError, writing


def export(
    result: EvaluationResult,
    folder: Path,
    form: str,
    dataset: str = "",
    source: str = "",
    *,
    partial: bool = False,
) -> list[Path]:
    """Write a result in one of the forms `vla-eval`, `lerobot` and `eval-results`; return the files."""
    if form == "eval-results":
        return export_eval_results(result, folder, dataset, source, partial=partial)
    return (export_vla_eval if form == "vla-eval" else export_lerobot)(result, folder)


def export_vla_eval(result: EvaluationResult, folder: Path) -> list[Path]:
    """Write `SUITE_aggregate.json` for each suite, as `vla-eval export` (0.8.0) writes it for a benchmark.

    An episode's number is its initial state, as in vla-eval's own LIBERO benchmark. Failures to run an episode count
    as failures in both; episodes that a simulation error ended are left out.

    Raises:
        ResultsError: A file cannot be written.
    """
    return [
        _write(folder / _named(suite, "_aggregate.json"), _aggregate(result, suite, tasks))
        for suite, tasks in result.by_suite.items()
    ]


def export_lerobot(result: EvaluationResult, folder: Path) -> list[Path]:
    """Write `eval_info.json`, as `lerobot-eval` (0.4 to 0.6) writes it: per task, per suite, overall.

    The reward of LIBERO is 1 at success and 0 before, so the sum and the maximum of an episode's rewards are both its
    success. No paths of videos are given.

    Raises:
        ResultsError: The file cannot be written.
    """
    suites, seconds = result.by_suite, result.times.get("busy_seconds")
    seconds = float(seconds) if isinstance(seconds, int | float) else float("nan")
    overall = _lerobot_rates(result.tasks)
    per_task = []
    for suite, tasks in suites.items():
        for place, task in enumerate(tasks):
            number = task.task.rpartition("/")[2]  # of the task in its suite; its place where the id has none
            rewards = [float(won) for won in task.successes]
            metrics = {"sum_rewards": rewards, "max_rewards": rewards, "successes": list(task.successes)}
            task_id = int(number) if number.isdigit() else place
            metrics |= {"video_paths": []}
            per_task.append({"task_group": suite, "task_id": task_id, "metrics": metrics})
    info = {
        "protocol": protocol_label(result.protocol, result.suites),
        "per_task": per_task,
        "per_group": {suite: _lerobot_rates(tasks) for suite, tasks in suites.items()},
        "overall": {**overall, "eval_s": seconds, "eval_ep_s": seconds / overall["n_episodes"]},
    }
    return [_write(folder / "eval_info.json", info)]


def export_eval_results(
    result: EvaluationResult, folder: Path, dataset: str, source: str = "", *, partial: bool = False
) -> list[Path]:
    """Write `.eval_results/SUITE.yaml` for each suite, which the Hugging Face Hub reads in the repository of a model.

    Args:
        result: The evaluation.
        folder: Folder of the repository.
        dataset: Id on the Hub of the benchmark's data set, whose `eval.yaml` names the suites as its tasks.
        source: Address of where this is from, such as a repository with `eval.json`.
        partial: Whether fewer tasks than the suite has, or fewer episodes than the protocol counts, may stand for it.

    Raises:
        ConfigError: An id or an address is not one, or the result is of a part of a suite.
        ResultsError: A file cannot be written.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", dataset):
        raise ConfigError(f"the data set of the benchmark is {dataset!r}; expected ORG/NAME, as on the Hub")
    if not re.fullmatch(r"(https?://\S+)?", source):
        raise ConfigError(f"the source is {source!r}; expected an address that begins with https://")
    lacks = {suite: _lacks(replace(result, tasks=tuple(tasks))) for suite, tasks in result.by_suite.items()}
    if not partial and (part := next((text for text in lacks.values() if text), None)):
        raise ConfigError(f"this is not the whole of the suite: {part}; with --partial its notes say so")
    names = ("protocol", "digest", "models", "initial states", "robot", "perturbed by", "horizon", "clock")
    paths = []
    for suite, tasks in result.by_suite.items():
        one = replace(result, tasks=tuple(tasks))
        success, described = one.success, dict(facts(one))
        count = sum(len(task.successes) for task in tasks)
        about = [
            *([f"PARTIAL: {lacks[suite]}"] if lacks[suite] else []),
            f"success in percent over {counted(count, 'episode')} of {counted(len(tasks), 'task')}",
            *[f"95 % interval {100 * success.low:.1f} to {100 * success.high:.1f}"] * (success.low >= 0),
            *(f"{name} {described[name]}" for name in names if name in described),
            *([result.stop_note] if result.stopped else []),
        ]
        entry = {
            "dataset": {"id": dataset, "task_id": suite},
            "value": round(100 * success.value, 2),
            **({"date": result.times["finished"]} if result.times.get("finished") else {}),
            **({"source": {"url": source, "name": "libero-lifelong"}} if source else {}),
            "evaluation_framework": "libero-lifelong",
            "notes": ", ".join(about),
        }
        path = own_folder(folder, ".eval_results", error=ConfigError) / _named(suite, ".yaml")
        with writing(path, "the result"):
            atomic_write_text(path, yaml.safe_dump([entry], sort_keys=False, allow_unicode=True, width=1000))
        paths.append(path)
    return paths


def _lacks(result: EvaluationResult) -> str:
    """Return what of a suite, and of its protocol's episodes, a result lacks, as text; empty for a whole one."""
    ((suite, label),) = result.suite_labels.items()
    least = min(len(task.starts) for task in result.tasks)
    trials = 1 if suite.startswith(PLUS) else section_of(result.protocol, "counting").get("trials")
    known = isinstance(trials, int) and least < trials
    return ", ".join([label] * (label != suite) + [f"{least} of {trials} episodes of a task"] * known)


def _aggregate(result: EvaluationResult, suite: str, tasks: Sequence[TaskResult]) -> dict[str, Any]:
    words = [
        task.instruction for task in tasks
    ]  # by which vla-eval knows tasks; some of libero_90 share them
    rows = [_vla_eval_task(task, words.count(task.instruction) == 1) for task in tasks]
    wins = [won for task in tasks for won in task.successes]
    seed = {"seed": result.evaluated["seed"]} if "seed" in result.evaluated else {}
    return {
        "benchmark": suite,
        "mode": "sync",
        "harness_version": f"libero-lifelong {result.versions.get('libero-lifelong', 'unknown')}",
        "created_at": result.times.get("finished"),
        "tasks": rows,
        "config": {
            "benchmark": "libero-lifelong",
            "params": {
                "suite": suite_label(suite, [task.task for task in tasks]),
                "protocol": protocol_label(result.protocol, [suite]),
                "seed": result.evaluated.get("seed"),
            },
            "evaluated": result.evaluated,
            "protocol": result.protocol,
            "environment": result.environment,
            "versions": result.versions,
        },
        "eval_id": result.outcomes.removeprefix("sha256:")[:16],
        **seed,
        "metric_keys": {"success": "mean"},
        "mean_success": round(float(np.mean(wins)), 4),
        "num_episodes_total": len(wins),
        "num_errors": sum(row.get("num_errors", 0) for row in rows),
    }


def _vla_eval_task(task: TaskResult, is_known: bool) -> dict[str, Any]:
    errors = task.errors or (None,) * len(task.successes)
    rows = zip(task.init_states, task.successes, task.lengths, errors, strict=True)
    episodes = [
        {"episode_id": init_state, "metrics": {"success": won}, "steps": steps}
        | ({"failure_reason": "exception", "failure_detail": error} if error else {})
        for init_state, won, steps, error in rows
    ]
    failed = sum(error is not None for error in errors)
    return {
        "task": task.instruction if is_known else f"{task.instruction} ({task.task})",
        "episodes": episodes,
        "num_episodes": len(episodes),
        "avg_steps": float(np.mean(task.lengths)),
        **({"num_errors": failed} if failed else {}),
        "mean_success": round(float(np.mean(task.successes)), 4),
    }


def _lerobot_rates(tasks: Sequence[TaskResult]) -> dict[str, Any]:
    wins = [won for task in tasks for won in task.successes]
    rate = float(np.mean(wins))
    means = {"avg_sum_reward": rate, "avg_max_reward": rate, "pc_success": 100 * rate}
    return {**means, "n_episodes": len(wins), "video_paths": []}


def _named(suite: str, ending: str) -> str:
    """Return the name of a suite's file; results may be somebody else's, and so is the suite."""
    if not re.fullmatch(r"[\w.-]+", suite):
        raise ConfigError(
            f"the suite {suite!r} does not make the name of a file; expected letters, digits, _ . -"
        )
    return f"{suite}{ending}"


def _write(path: Path, values: Mapping[str, Any]) -> Path:
    with writing(path, "the result"):
        write_json(path, values)
    return path
