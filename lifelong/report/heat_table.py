"""Success matrices as table cells with text, colours and tooltips."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lifelong.report.figures import cell_colours
from lifelong.results.results import Results
from lifelong.stats.intervals import mean_and_standard_error, wilson_interval


def run_heatmap(results: Results, labels: Sequence[str]) -> dict[str, Any]:
    """Return the cells of one run's matrix: percent, colours, and Wilson's interval as the tooltip."""
    rates, episodes = results.success_matrix()
    low, high = wilson_interval(np.nan_to_num(rates) * episodes, episodes)
    spread = "{} of {} episodes; 95 % interval {} to {} %"

    def hint(i: int, j: int) -> str:
        ends = (f"{100 * end[i, j]:.0f}" for end in (low, high))
        return spread.format(round(rates[i, j] * episodes[i, j]), episodes[i, j], *ends)

    def detail(i: int, j: int) -> str:
        return f"{100 * low[i, j]:.0f}–{100 * high[i, j]:.0f}"

    return _grid(rates, labels, hint, detail)


def mean_heatmap(matrices: np.ndarray, mean: np.ndarray, labels: Sequence[str]) -> dict[str, Any]:
    """Return the cells of the mean over seeds, with its standard error as the tooltip."""

    def spread(i: int, j: int) -> tuple[float, int]:
        values = matrices[:, i, j][~np.isnan(matrices[:, i, j])]
        return 100 * mean_and_standard_error(values)[1], len(values)

    def hint(i: int, j: int) -> str:
        error, count = spread(i, j)
        return f"mean of {count} seeds, standard error {error:.1f}" if count > 1 else "one seed"

    return _grid(mean, labels, hint, lambda i, j: "")


def _grid(
    rates: np.ndarray,
    labels: Sequence[str],
    hint: Callable[[int, int], str],
    detail: Callable[[int, int], str],
) -> dict[str, Any]:
    """Return the rows of the table; cells without an evaluation are None."""

    def cell(i: int, j: int) -> dict[str, str] | None:
        if np.isnan(rates[i, j]):
            return None
        back, ink = cell_colours(float(rates[i, j]))
        text = f"{100 * rates[i, j]:.0f}"
        where = f"after task {i + 1} ({labels[i]}), on task {j + 1} ({labels[j]}): {text} %"
        tooltip = f"{where}\n{hint(i, j)}"
        return {"text": text, "detail": detail(i, j), "hint": tooltip, "back": back, "ink": ink}

    size, rows = len(rates), []
    for i in range(size):
        known = rates[i, : i + 1]
        average = f"{100 * known.mean():.0f}" if not np.isnan(known).any() else ""
        rows.append({"label": labels[i], "cells": [cell(i, j) for j in range(size)], "average": average})
    return {"rows": rows, "size": size, "title": ""}
