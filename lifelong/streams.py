"""What is learned in which order: tasks in groups, fewer demonstrations later on, boundaries that are not sharp.

A stage is what is learned at a time: a task, or a group of them. It goes by its last task, in the hooks of
algorithms, in records and in the names of files.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm, JoinedWindows, WindowDataset
from lifelong.errors import ConfigError
from lifelong.seeding import generator
from lifelong.types import Batch

BLUR = 4  # first word of a seed, see `lifelong.sequence`

Stages = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class StreamSettings:
    """How data come in; the defaults are the benchmark's: all of a task, and nothing else, at a time.

    Attributes:
        demos_later: Demonstrations of each task after the first one (or after the first group): how many, which
            share of `data.demos` (a number with a point, up to 1.0), or a list with as many entries as there are
            such tasks. None: as many as of the first.
        blur: Share of each stage's windows that come with neighbouring stages instead of their own.
        blur_reach: How many stages before and after count as neighbours.

    With `blur`, a stage's windows are split at random, once for the whole run: a share of `1 - blur` is learned
    when its turn comes, the rest is dealt evenly to the neighbours. Every window is learned in one stage and no
    other. That is the Blurry-M stream of Bang et al. 2021 ("Rainbow memory", section 3: each task consists of
    100 - M % of its own classes' samples and M % of the others'), here between neighbours, as near a boundary;
    Koh et al. 2022 (i-Blurry) blur likewise with classes that never end beside it. Algorithms are told of stages
    as before: what is in them is mixed, and the memory of a stage is too. Success on a task before its turn
    (epoch 0 of its learning curve) then is no longer that of a task never seen.
    """

    demos_later: int | float | Sequence[int] | None = None
    blur: float = 0.0
    blur_reach: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.blur < 1:
            raise ConfigError(f"stream.blur is {self.blur}; it must be a share: at least 0 and below 1")
        if self.blur_reach < 1:
            raise ConfigError(f"stream.blur_reach is {self.blur_reach}; it must be at least 1 stage")

    def demos(self, full: int, tasks: int, first: int = 1) -> tuple[int, ...]:
        """Demonstrations of each task.

        Args:
            full: Those of a task at the beginning.
            tasks: Number of tasks, K.
            first: Tasks of the first stage.

        Raises:
            ConfigError: `demos_later` is no number of demonstrations, or a list of another length.
        """
        later, rest = self.demos_later, tasks - first
        if later is None:
            counts = [full] * rest
        elif isinstance(later, int | float):
            counts = [later if isinstance(later, int) else self._share(later, full)] * rest
        else:
            counts = list(later)
            if len(counts) != rest:
                raise ConfigError(
                    f"stream.demos_later lists {len(counts)} tasks; {rest} come after the first stage"
                )
        if any(not isinstance(n, int) or n < 1 for n in counts):
            raise ConfigError(
                f"stream.demos_later is {later!r}; valid: numbers of demonstrations from 1 on, or a share such "
                "as 0.2"
            )
        return (*[full] * first, *counts)

    @staticmethod
    def _share(share: float, full: int) -> int:
        if not 0 < share <= 1:
            raise ConfigError(
                f"stream.demos_later is {share}; as a share it must be above 0 and at most 1.0, a number of "
                "demonstrations has no point"
            )
        return max(1, round(share * full))


def stages_of(algorithm: Algorithm, tasks: int, group_size: int = 1) -> Stages:
    """What is learned together, stage after stage: the groups, or what an algorithm joins of them.

    Args:
        algorithm: One that learns everything at once has one stage.
        tasks: Number of tasks, K.
        group_size: Tasks of a group, which divides K.
    """
    groups = [tuple(range(k, k + group_size)) for k in range(0, tasks, group_size)]
    stages = algorithm.stages(len(groups))
    return tuple(tuple(task for group in stage for task in groups[group]) for stage in stages)


class StageWindows(JoinedWindows):
    """The windows of a stage that has more than one task in it, as those of its last task.

    Batches name that task, count windows through all datasets and keep the order asked for, so that an algorithm
    which keeps windows of a stage finds them again by what a batch says.
    """

    def __init__(self, datasets: Sequence[WindowDataset], task_id: int):
        super().__init__(datasets)
        self.task_id = task_id
        self._ends = torch.tensor([len(d) for d in datasets]).cumsum(0)

    def batch(self, indices: Tensor) -> Batch:
        """The windows of these indices ((B,) int64, counted through all datasets), as one batch."""
        indices = torch.as_tensor(indices, dtype=torch.int64, device="cpu")
        batch = super().batch(indices)  # one dataset's after another's
        places = torch.bucketize(indices, self._ends, right=True).argsort(stable=True).argsort()
        batch = batch.rows(places.to(batch.window_ids.device))
        task_ids = torch.full_like(batch.task_ids, self.task_id)
        return replace(batch, task_ids=task_ids, window_ids=indices.to(batch.window_ids))


@dataclass(frozen=True, eq=False)
class SomeWindows:
    """Some of a dataset's windows."""

    dataset: WindowDataset
    chosen: Tensor  # (n,) int64

    def __len__(self) -> int:
        return len(self.chosen)

    def batch(self, indices: Tensor) -> Batch:
        """The windows of these indices ((B,) int64 in [0, n)), as one batch."""
        return self.dataset.batch(self.chosen[indices])


@dataclass(frozen=True)
class StageData(Mapping[int, WindowDataset]):
    """What is learned at each stage, by its last task.

    Attributes:
        datasets: Windows of each task, by position; each is read when asked for.
        stages: See `stages_of`.
        settings: Of the stream.
        seed: Of the run: it decides which windows come with a neighbour.
    """

    datasets: Mapping[int, WindowDataset]
    stages: Stages
    settings: StreamSettings
    seed: int

    def __getitem__(self, last: int) -> WindowDataset:
        ends = list(self)
        if last not in ends:
            raise KeyError(last)
        here = ends.index(last)
        if not self.settings.blur:
            return self._own(here)
        parts = [self._given(here, here)] + [self._given(k, here) for k in self._neighbours(here)]
        return StageWindows([part for part in parts if len(part)], last)

    def __iter__(self) -> Iterator[int]:
        return iter(stage[-1] for stage in self.stages)

    def __len__(self) -> int:
        return len(self.stages)

    def _own(self, place: int) -> WindowDataset:
        """All windows of a stage's tasks."""
        stage = self.stages[place]
        if len(stage) == 1:
            return self.datasets[stage[0]]
        return StageWindows([self.datasets[task] for task in stage], stage[-1])

    def _neighbours(self, place: int) -> list[int]:
        reach = self.settings.blur_reach
        near = range(max(0, place - reach), min(len(self.stages), place + reach + 1))
        return [k for k in near if k != place]

    def _given(self, giver: int, taker: int) -> SomeWindows:
        """The windows of one stage that are learned in another, or in itself."""
        windows, takers = self._own(giver), self._neighbours(giver)
        draws = generator(self.seed, BLUR, self.stages[giver][-1])
        order = torch.randperm(len(windows), generator=draws)
        away = round(self.settings.blur * len(windows)) if takers else 0
        if giver == taker:
            return SomeWindows(windows, order[away:].sort().values)
        return SomeWindows(windows, order[:away].tensor_split(len(takers))[takers.index(taker)].sort().values)
