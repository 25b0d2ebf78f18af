"""Results of evaluations for tests: success by task and start, drawn or given."""

from collections.abc import Sequence

import numpy as np

from libero_eval.evaluation_file import EvaluationResult, TaskResult

PROTOCOL = {"name": "openpi", "horizon": {"libero_goal": 300, "libero_object": 280}, "settle_steps": 10}
ENVIRONMENT = {"models": "builtin", "robot": "libero", "drawing": "fast", "renderer": "egl"}


def task_result(
    task: str, successes: Sequence[bool], starts: Sequence[int] | None = None, **changes
) -> TaskResult:
    """Return a task's result with these successes, from the first start on unless starts are given."""
    starts = range(len(successes)) if starts is None else starts
    values = {
        "task": task,
        "name": task.replace("/", "_"),
        "instruction": f"do what {task} asks",
        "init_states": tuple(starts),
        "successes": tuple(bool(s) for s in successes),
        "lengths": tuple(100 + s for s in starts),
    }
    return TaskResult(**(values | changes))


def result_of(*tasks: TaskResult, policy: str = "mine:make", seed: int = 0, **changes) -> EvaluationResult:
    """Return a result of these tasks."""
    values = {
        "evaluated": {"policy": policy, "seed": seed},
        "protocol": PROTOCOL,
        "init_states": tasks[0].init_states,
        "versions": {"mujoco": "4.0.0", "libero-lifelong": "0.1.0"},
        "tasks": tasks,
        "environment": ENVIRONMENT,
        "times": {"finished": "2026-01-01T00:00:00+00:00", "busy_seconds": 60.0},
    }
    return EvaluationResult(**(values | changes))


def drawn_result(
    rate: float, draw: int, *, flip: float = 0.1, suites=("libero_goal",), tasks: int = 10, **changes
) -> EvaluationResult:
    """Return a result in which the same starts are hard for every policy, and a share of them is up to chance."""
    hard, own = np.random.default_rng(7), np.random.default_rng([draw, 1])
    rows = []
    for suite in suites:
        for number in range(tasks):
            won = hard.random(50) < rate
            won = np.where(own.random(50) < flip, own.random(50) < rate, won)
            rows.append(task_result(f"{suite}/{number}", won))
    return result_of(*rows, **changes)
