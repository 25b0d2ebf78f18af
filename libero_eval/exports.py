"""Results of an evaluation in the formats of vla-eval and of LeRobot."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text
from libero_env.text import json_safe
from libero_eval.evaluation_file import EvaluationResult, TaskResult
from lifelong.errors import ResultsError


def export_vla_eval(result: EvaluationResult, folder: Path) -> list[Path]:
    """Write `SUITE_aggregate.json` for each suite, as `vla-eval export` (0.8.0) writes it for a benchmark.

    An episode's number is its initial state, as in vla-eval's own LIBERO benchmark. Failures to run an episode count
    as failures in both.

    Raises:
        ResultsError: A file cannot be written.
    """
    return [
        _write(folder / f"{suite}_aggregate.json", _aggregate(result, suite, tasks))
        for suite, tasks in _by_suite(result).items()
    ]


def export_lerobot(result: EvaluationResult, folder: Path) -> list[Path]:
    """Write `eval_info.json`, as `lerobot-eval` (0.4 to 0.6) writes it: per task, per suite, overall.

    The reward of LIBERO is 1 at success and 0 before, so the sum and the maximum of an episode's rewards are both its
    success. No paths of videos are given.

    Raises:
        ResultsError: The file cannot be written.
    """
    groups = _by_suite(result)
    seconds = _seconds(result)
    overall = _lerobot_rates(result.tasks)
    timed = {"eval_s": seconds, "eval_ep_s": seconds / overall["n_episodes"]}
    info = {
        "per_task": [
            {"task_group": suite, "task_id": _index(task, i), "metrics": _lerobot_episodes([task])}
            for suite, tasks in groups.items()
            for i, task in enumerate(tasks)
        ],
        "per_group": {suite: _lerobot_rates(tasks) for suite, tasks in groups.items()},
        "overall": {k: v for k, v in overall.items() if k != "video_paths"} | timed | {"video_paths": []},
    }
    return [_write(folder / "eval_info.json", info)]


def _aggregate(result: EvaluationResult, suite: str, tasks: Sequence[TaskResult]) -> dict[str, Any]:
    rows = [_vla_eval_task(task) for task in tasks]
    errors = sum(row.get("num_errors", 0) for row in rows)
    wins = [won for task in tasks for won in task.successes]
    config = {
        "benchmark": "libero-lifelong",
        "params": {"suite": suite, "seed": result.evaluated.get("seed")},
        "evaluated": dict(result.evaluated),
        "protocol": dict(result.protocol),
        "environment": dict(result.environment),
        "versions": dict(result.versions),
    }
    return {
        "benchmark": suite,
        "mode": "sync",
        "harness_version": f"libero-lifelong {result.versions.get('libero-lifelong', 'unknown')}",
        "created_at": result.times.get("finished"),
        "tasks": rows,
        "config": config,
        "eval_id": result.outcomes.removeprefix("sha256:")[:16],
        **({"seed": result.evaluated["seed"]} if "seed" in result.evaluated else {}),
        "metric_keys": {"success": "mean"},
        "mean_success": round(float(np.mean(wins)), 4),
        "num_episodes_total": len(wins),
        "num_errors": errors,
    }


def _vla_eval_task(task: TaskResult) -> dict[str, Any]:
    errors = task.errors or (None,) * len(task.successes)
    episodes = [
        {"episode_id": start, "metrics": {"success": won}, "steps": steps}
        | ({"failure_reason": "exception", "failure_detail": error} if error else {})
        for start, won, steps, error in zip(
            task.init_states, task.successes, task.lengths, errors, strict=True
        )
    ]
    failed = sum(error is not None for error in errors)
    return {
        "task": task.instruction,
        "episodes": episodes,
        "num_episodes": len(episodes),
        "avg_steps": float(np.mean(task.lengths)),
        **({"num_errors": failed} if failed else {}),
        "mean_success": round(float(np.mean(task.successes)), 4),
    }


def _lerobot_episodes(tasks: Sequence[TaskResult]) -> dict[str, Any]:
    wins = [won for task in tasks for won in task.successes]
    rewards = [float(won) for won in wins]
    return {"sum_rewards": rewards, "max_rewards": rewards, "successes": wins, "video_paths": []}


def _lerobot_rates(tasks: Sequence[TaskResult]) -> dict[str, Any]:
    rate = float(np.mean([won for task in tasks for won in task.successes]))
    return {
        "avg_sum_reward": rate,
        "avg_max_reward": rate,
        "pc_success": 100 * rate,
        "n_episodes": sum(len(task.successes) for task in tasks),
        "video_paths": [],
    }


def _by_suite(result: EvaluationResult) -> dict[str, list[TaskResult]]:
    found: dict[str, list[TaskResult]] = {}
    for task in result.tasks:
        found.setdefault(task.task.partition("/")[0], []).append(task)
    return found


def _index(task: TaskResult, place: int) -> int:
    """Return the number of a task in its suite; its place in the result if its id has none."""
    number = task.task.rpartition("/")[2]
    return int(number) if number.isdigit() else place


def _seconds(result: EvaluationResult) -> float:
    """Return the wall time of the evaluation, NaN if it is not recorded."""
    value = result.times.get("seconds")
    return float(value) if isinstance(value, int | float) else float("nan")


def _write(path: Path, values: Mapping[str, Any]) -> Path:
    try:
        atomic_write_text(path, json.dumps(json_safe(values), indent=2, ensure_ascii=False) + "\n")
    except OSError as error:
        raise ResultsError(f"{path}: the result cannot be written ({error})") from error
    return path
