"""The runs of one or several methods as samples of every metric, with their starts in one common order."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.results.clusters import Contributions, contributions
from lifelong.results.components import Sample
from lifelong.results.curves import forward_transfer
from lifelong.results.scores import METRIC_NAMES, Scores, area_under_curve, negative_backward_transfer


@dataclass(frozen=True)
class Member:
    """One run of a method.

    Attributes:
        scores: Success of the run, with its outcomes.
        seed: Its seed.
        order: Identifier of its task order.
    """

    scores: Scores
    seed: Hashable = None
    order: Hashable = None


def metric_values(scores: Scores) -> dict[str, float]:
    """Return the value of every metric; NaN where it is undefined."""
    fwt, matrix = forward_transfer(scores.curves, scores.transfer), scores.matrix
    return {
        "fwt": float(fwt.mean()),
        "nbt": float(negative_backward_transfer(matrix).mean()),
        "auc": float(area_under_curve(fwt, matrix).mean()),
        "final_success": float(matrix[-1].mean()),
        "just_learned": float(np.diag(matrix).mean()),
    }


def samples(groups: Mapping[str, Sequence[Member]]) -> dict[str, dict[str, Sample]]:
    """Return each metric of each group of runs, by the metric's name and the group's label.

    Where a group has several orders of tasks, these are what is drawn independently, and the runs of an order are
    averaged; otherwise it is the seeds.

    Args:
        groups: Runs by the label of their group; at least one in each.
    """
    parts = {label: [contributions(m.scores) for m in members] for label, members in groups.items()}
    strata = {
        cluster: stratum
        for found in parts.values()
        for part in found
        for cluster, stratum in zip(part.clusters, part.strata, strict=True)
    }
    place = {cluster: i for i, cluster in enumerate(strata)}
    kinds = {stratum: i for i, stratum in enumerate(dict.fromkeys(strata.values()))}
    numbers = np.array([kinds[stratum] for stratum in strata.values()], dtype=np.int64)
    found: dict[str, dict[str, Sample]] = {name: {} for name in METRIC_NAMES}
    for label, members in groups.items():
        values = [metric_values(m.scores) for m in members]
        units = _units(members)
        for name in METRIC_NAMES:
            found[name][label] = _sample(name, units, values, parts[label], place, numbers)
    return found


def _units(members: Sequence[Member]) -> dict[Hashable, list[int]]:
    """Return the runs of each unit that is drawn independently."""
    several = len({m.order for m in members}) > 1
    units: dict[Hashable, list[int]] = {}
    for number, member in enumerate(members):
        units.setdefault(member.order if several else member.seed, []).append(number)
    return units


def _sample(
    name: str,
    units: Mapping[Hashable, Sequence[int]],
    values: Sequence[Mapping[str, float]],
    parts: Sequence[Contributions],
    place: Mapping[tuple[str, int], int],
    strata: NDArray[np.int64],
) -> Sample:
    deviations = np.zeros((len(units), len(strata)))
    for row, runs in enumerate(units.values()):
        for run in runs:
            where = [place[cluster] for cluster in parts[run].clusters]
            deviations[row, where] += parts[run].deviations[name] / len(runs)
    return Sample(
        units=tuple(units),
        values=np.array([np.mean([values[run][name] for run in runs]) for runs in units.values()]),
        deviations=deviations,
        strata=strata,
        noise=np.array([sum(parts[r].noise[name] for r in runs) / len(runs) ** 2 for runs in units.values()]),
    )
