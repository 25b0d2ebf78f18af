"""Settings of the measurement of success."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from libero_env.errors import LiberoError
from libero_env.perturbations import Perturbation
from libero_env.sim.backend import MUJOCO, Backend
from libero_env.tasks.task import NUM_INIT_STATES
from libero_env.validation import checked
from lifelong.data.settings import PerturbSetting, read_perturbations
from lifelong.errors import ConfigError
from lifelong.results.cells import MatrixCells, measured_tasks
from lifelong.results.records import Phase
from lifelong.stats.metrics import Transfer
from lifelong.types import Count, Natural, Share

Selection = Literal["best", "first_best", "last"]


@checked
class EvalSettings:
    """Settings of the measurement of success; the defaults are those of LIBERO's paper, except `selection`.

    Attributes:
        episodes: Number of rollouts per cell of the success matrix; they start in the first initial states.
        curve_episodes: Number of rollouts per point of a learning curve.
        every: Number of epochs between two points of a learning curve; it also has epoch 0 and the last epoch.
        curve: Points of a learning curve: `all`; `trained`, without epoch 0, so that forward transfer is the mean over
            the other points; `none`, so that it is not defined.
        cells: Cells of the success matrix: `all`; `diagonal`, each task just after learning it; `last_row`, all
            tasks at the end; or both of these, `diagonal_and_last_row`. Metrics that need other cells are not defined.
            `sampled` adds a random share of the others to both, from which NBT and AUC are estimated without bias, see
            `lifelong.stats.metrics.estimate_cells`.
        cells_share: Share of the earlier tasks that `sampled` measures after each task.
        cells_seed: Seed by which these are drawn. A run whose configuration has none draws by its own seed, so that the
            error of the sample differs between seeds, and is in their intervals.
        unseen: Whether tasks are evaluated before they are learned: the `next` after each task, or `all` that are to
            come; and all before the first task. Zero-shot success and forward transfer in GEM's sense follow.
        held_out: Suite whose tasks, but for those that the run learns, are evaluated before the first task and after
            the last, by what acts on that one. None: no such evaluation.
        reuse: Whether rollouts that would repeat earlier ones to the bit are copied instead of run: same weights and
            whatever else acts, same starts, nothing random.
        horizon: Maximum number of control steps per episode.
        settle_steps: Number of steps with a zero action before the policy acts.
        selection: Initial states of the learning curve, by which the best epoch is chosen. `apart`: the last
            ones of the 50, which no reported number uses. `reporting`: those of the reported numbers, as LIBERO
            does.
        select: Weights that are kept of a task: those of the `best` epoch, the latest of equally good ones; of the
            `first_best`, the earliest of them, as in LIBERO's code: those from before the task where nothing succeeds;
            or of the `last`.
        until: Success at a point of the learning curve at which a task counts as learned: training on it ends there. A
            number, or one for each task in learning order. Curves then differ in length, and FWT is over what they
            have. Phases without a curve, such as PackNet's after pruning, are trained whole. None: all epochs are.
        transfer: Estimate of forward transfer. `unbiased`: where the best epoch is kept, it is chosen without the start
            that measures it, and where the last one is, none is held. `published`: eq. 3 as written, which holds the
            largest of the measured points; so does `unbiased` where the best of points of one rollout is kept.
        precision: Precision of the policy, see `FitSettings`.
        record_every: Number of control steps between two frames of the recorded rollouts; 0 records none.
        open_environments: Number of environments kept open, of different tasks.
        sim_threads: Number of threads that step simulations; 0 uses all cores.
        beside: Whether the success matrix is measured, and demonstrations of later tasks are recorded, in processes of
            their own while a task is learned, to the same bits; on a CPU with several cores only.
        backend: Back end of the rollouts, `mujoco` or `warp` with its settings, such as `warp,device=cuda:1`.
        shift: Perturbations under which each task just learned, and all tasks at the end, are evaluated besides, from
            the same starts; as for `stream.perturb`, of any kinds. It may be chosen when a run is resumed or finished.
            None: no such evaluation.
    """

    episodes: Count = 20
    curve_episodes: Count = 20
    every: Count = 5
    curve: Literal["all", "trained", "none"] = "all"
    cells: MatrixCells = "all"
    cells_share: Annotated[float, Field(gt=0, le=1)] = 0.1
    cells_seed: Natural | None = None
    unseen: Literal["none", "next", "all"] = "none"
    held_out: str | None = None
    reuse: bool = True
    horizon: Count = 600
    settle_steps: Natural = 5
    selection: Literal["apart", "reporting"] = "apart"
    select: Selection = "best"
    until: Share | Sequence[Share] | None = None
    transfer: Literal["unbiased", "published"] = "unbiased"
    precision: Literal["auto", "bf16", "fp32", "fp32_strict"] = "auto"
    record_every: Natural = 4
    open_environments: Count = 4
    sim_threads: Natural = 0
    beside: bool = False
    backend: str = MUJOCO
    shift: PerturbSetting | None = None

    def __post_init__(self) -> None:
        try:
            self.back_end.require_installed()
        except LiberoError as error:
            raise ConfigError(f"eval.backend: {error}") from error
        for name in ("cells_share", "cells_seed"):
            if self.cells != "sampled" and getattr(self, name) != getattr(type(self), name):
                raise ConfigError(
                    f"eval.{name} has no effect without eval.cells=sampled; leave it out, or set both"
                )
        self.shift_perturbations()
        if self.until is not None and (self.select, self.curve) not in (("last", "all"), ("last", "trained")):
            raise ConfigError(
                "eval.until keeps the weights that reach it: set eval.select=last, and a learning curve"
            )
        points = 0 if self.curve == "none" else self.curve_episodes
        needed = self.episodes + (points if self.selection == "apart" else 0)
        if max(needed, points) > NUM_INIT_STATES:
            raise ConfigError(
                f"eval.episodes={self.episodes} and eval.curve_episodes={points} need {needed} "
                f"initial states, a task has {NUM_INIT_STATES}: lower one of them, or set "
                "eval.selection=reporting"
            )
        if self.curve == "none" and self.select != "last":
            raise ConfigError(
                f"eval.select={self.select} needs a learning curve, and eval.curve=none has none: set eval.select=last"
            )

    @property
    def back_end(self) -> Backend:
        """Back end of the rollouts."""
        return Backend.read(self.backend)

    @property
    def transfer_estimate(self) -> Transfer:
        """Estimate of forward transfer by its name in `lifelong.stats.metrics`."""
        if self.transfer == "unbiased" and self.select == "last":
            return "plain"
        return "published" if self.transfer == "published" or self.curve_episodes == 1 else "cross_fitted"

    def enough(self, stage: Sequence[int]) -> float | None:
        """Return the success at which training on a stage ends, of several tasks the mean; None for all epochs."""
        if not isinstance(self.until, Sequence):
            return self.until
        return round(sum(self.until[task] for task in stage) / len(stage), 9)

    def shift_perturbations(self) -> tuple[Perturbation, ...]:
        """Return the perturbations of the held-out shift; none without one.

        Raises:
            ConfigError: They are not valid.
        """
        return read_perturbations(self.shift, "eval.shift")

    def init_states(self, phase: Phase) -> range:
        """Return the indices of a phase's initial states: `curve`, or of the success matrix and under a shift."""
        if phase != "curve":
            return range(self.episodes)
        if self.selection == "reporting":
            return range(self.curve_episodes)
        return range(NUM_INIT_STATES - self.curve_episodes, NUM_INIT_STATES)

    def curve_epochs(self, epochs: int) -> tuple[int, ...]:
        """Return the epochs at which a learning curve has points, given the number of epochs."""
        if self.curve == "none":
            return ()
        first = 0 if self.curve == "all" else self.every
        return tuple(sorted({*range(first, epochs + 1, self.every), epochs}))

    def row(self, stage: Sequence[int], tasks: int) -> Sequence[int]:
        """Return the tasks that are measured after a stage of a run of so many tasks."""
        return measured_tasks(self.cells, stage, tasks, self.cells_share, self.cells_seed)

    def unseen_tasks(self, later: Sequence[Sequence[int]]) -> list[int]:
        """Return the tasks that are evaluated although they are not learned, of the later stages."""
        counted = {"none": later[:0], "next": later[:1], "all": later}[self.unseen]
        return [task for stage in counted for task in stage]

    def shifted_row(self, stage: Sequence[int], tasks: int) -> Sequence[int]:
        """Return the tasks that are evaluated under the held-out shift after a stage of a run of so many tasks."""
        if not self.shift_perturbations():
            return range(0)
        return measured_tasks("diagonal_and_last_row", stage, tasks)
