"""Errors on demonstrations that were not learned from."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from libero_env.tasks import Task
from libero_eval.relearning import MEASURED, error_on
from lifelong.algorithms import Algorithm
from lifelong.policies.base import Policy
from lifelong.tuning.trials import StreamData, open_stream
from lifelong.types import Batch


def open_both(config: Mapping[str, Any], tasks: Sequence[Task], more: int) -> tuple[StreamData, list[Batch]]:
    """Return the windows to learn from, and those of as many `more` demonstrations of each task, at equal distances."""
    data = config["data"]
    everything = open_stream({**config, "data": {**data, "demos": data["demos"] + more}}, tasks)
    few, batches = open_stream(config, tasks), []
    for windows, every in zip(few.training, everything.training, strict=True):
        left = len(every) - len(windows)
        rows = len(windows) + torch.linspace(0, left - 1, min(left, MEASURED)).round().long()
        batches.append(every.batch(rows))
    return few, batches


def errors(algorithm: Algorithm, policy: Policy, batches: Sequence[Batch]) -> list[float]:
    """Return the mean absolute error of the actions on each task."""
    found = []
    for task, batch in enumerate(batches):
        with algorithm.policy_for(task, policy) as acting:
            found.append(error_on(acting, batch))
    return found
