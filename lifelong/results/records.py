"""Records of a run: frozen values, one JSON line each. Tasks are positions in the sequence."""

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import accumulate
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, WrapValidator

from libero_env.errors import InvalidInputError
from libero_env.validation import validate
from lifelong.results.coverage import MatrixCells
from lifelong.stats.metrics import Transfer

_CHECKSUM = "crc32"

Count = Annotated[int, Field(ge=0, le=10**9)]
Phase = Literal["curve", "matrix", "shift"]
Number = Annotated[float, WrapValidator(lambda value, parse: math.nan if value is None else parse(value))]


@dataclass(frozen=True)
class RunRecord:
    """One start of the process; a resumed run has several. The first names the run."""

    kind: Literal["run"] = field(default="run", init=False)
    algo: str
    benchmark: str
    policy: str
    seed: int
    preset: str
    tasks: tuple[str, ...]  # names, in learning order
    instructions: tuple[str, ...]  # of the tasks, in the same order
    config_digest: str
    versions: Mapping[str, str]
    commit: str | None
    cpu_count: Count
    started: str  # ISO 8601, UTC
    group_size: Annotated[int, Field(ge=1, le=1000)] = 1  # tasks learned together as one step of the sequence
    conditions: Mapping[str, str] = field(default_factory=dict)  # see `lifelong.results.conditions`
    cells: MatrixCells = "all"  # of the success matrix, which are measured
    # of each group, where they are not all of group_size
    group_sizes: tuple[Annotated[int, Field(ge=1)], ...] = ()
    transfer: Transfer = "cross_fitted"  # estimate of forward transfer, see `lifelong.stats.metrics`
    # perturbations of each task, in learning and evaluation; () for none at all
    perturbed: tuple[str, ...] = ()
    backend: str = "mujoco"  # of the rollouts: mujoco or warp

    def __post_init__(self) -> None:
        if not len(self.tasks) == len(self.instructions) > 0:
            raise ValueError(f"a run of {len(self.tasks)} tasks has {len(self.instructions)} instructions")
        if len(self.perturbed) not in (0, len(self.tasks)):
            raise ValueError(f"a run of {len(self.tasks)} tasks has {len(self.perturbed)} perturbations")
        sizes = self.group_sizes
        if sum(sizes) != len(self.tasks) if sizes else len(self.tasks) % self.group_size:
            raise ValueError(
                f"{len(self.tasks)} tasks are no groups of {', '.join(map(str, sizes or [self.group_size]))}"
            )

    @property
    def groups(self) -> tuple[range, ...]:
        """Positions of the tasks in each group that is one step of the sequence."""
        sizes = self.group_sizes or (self.group_size,) * (len(self.tasks) // self.group_size)
        return tuple(range(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True))

    @property
    def has_base_stage(self) -> bool:
        """Whether more tasks were learned together first than in any later group."""
        return bool(self.group_sizes) and self.group_sizes[0] > max(self.group_sizes[1:])

    def group(self, task: int) -> range:
        """Return the positions of the tasks in a task's group."""
        return next(group for group in self.groups if task in group)


@dataclass(frozen=True)
class LossRecord:
    """The mean training loss of one epoch (epochs count from 1) and its wall time."""

    kind: Literal["loss"] = field(default="loss", init=False)
    task: Count
    epoch: Count
    loss: Number
    seconds: Number


@dataclass(frozen=True)
class EvalRecord:
    """Rollouts on one task: `phase` "curve" while learning it, "matrix" after learning task `learned`.

    Rollouts under a held-out shift (`eval.shift`) after learning task `learned` have the phase "shift" and the
    perturbations as text; all others are under the perturbations of the run's task, see `RunRecord.perturbed`.

    The epoch is the number of epochs trained on task `learned` when the policy was frozen (0: zero-shot). For each
    episode the record states which atoms of the goal held before the policy acted, at any time from then on, and at
    the end; older records do not.

    Rollouts that would repeat earlier ones to the bit are not run: their record is a copy, with the key of the one it
    is a copy of, and takes 0 seconds.
    """

    kind: Literal["eval"] = field(default="eval", init=False)
    phase: Phase
    learned: Count
    epoch: Count
    task: Count
    successes: tuple[bool, ...]  # one per episode
    lengths: tuple[Count, ...]  # [control steps]
    init_states: tuple[Count, ...]
    seconds: Number
    atoms: tuple[str, ...] = ()  # of the goal, such as (On plate_1 stove_1)
    atoms_at_start: tuple[tuple[bool, ...], ...] = ()  # (episodes, atoms)
    atoms_ever: tuple[tuple[bool, ...], ...] = ()
    atoms_at_end: tuple[tuple[bool, ...], ...] = ()
    # digest of all that the rollouts depend on; empty where they also depend on random draws
    decided_by: str = ""
    # phase, learned, epoch of the original
    same_as: tuple[Phase, Count, Count] | None = None
    shift: str = ""

    def __post_init__(self) -> None:
        if self.phase not in get_args(Phase):
            raise ValueError(f"phase of an evaluation is 'curve', 'matrix' or 'shift', not {self.phase!r}")
        if (self.phase == "shift") != bool(self.shift):
            raise ValueError(f"an evaluation of phase {self.phase!r} has the shift {self.shift!r}")
        if not len(self.successes) == len(self.lengths) == len(self.init_states) > 0:
            raise ValueError(
                "an evaluation needs equal numbers of successes, lengths and initial states, at least one; got "
                f"{len(self.successes)}, {len(self.lengths)} and {len(self.init_states)}"
            )
        for name in ("atoms_at_start", "atoms_ever", "atoms_at_end"):
            shape = [len(row) for row in getattr(self, name)]
            if self.atoms and shape != [len(self.atoms)] * len(self.successes):
                raise ValueError(
                    f"{name} of an evaluation needs a row for each episode and a column for each atom"
                )

    @property
    def rate(self) -> float:
        """Success rate of the episodes."""
        return sum(self.successes) / len(self.successes)

    @property
    def outcome(self) -> tuple[Any, ...]:
        """What the rollouts came to, without where and when they were run."""
        atoms = (self.atoms, self.atoms_at_start, self.atoms_ever, self.atoms_at_end)
        return (self.successes, self.lengths, self.init_states, *atoms)


@dataclass(frozen=True)
class PhaseRecord:
    """Wall time of something that is neither a training epoch nor an evaluation, such as "demos"."""

    kind: Literal["phase"] = field(default="phase", init=False)
    phase: str
    seconds: Number


@dataclass(frozen=True)
class DemonstrationsRecord:
    """The demonstrations that the process which started last learns from, by task.

    Attributes:
        counts: Number of demonstrations.
        generators: What recorded them, such as `scripted-expert-1`; "" where their file does not say.
        digests: Digest of their states and actions, see `libero_env.demos.DemoOrigin`.
    """

    kind: Literal["demonstrations"] = field(default="demonstrations", init=False)
    counts: tuple[Count, ...]
    generators: tuple[str, ...]
    digests: tuple[str, ...]

    def __post_init__(self) -> None:
        if not len(self.counts) == len(self.generators) == len(self.digests) > 0:
            raise ValueError(
                f"{len(self.counts)} counts have {len(self.generators)} generators and {len(self.digests)} digests"
            )


@dataclass(frozen=True)
class CostRecord:
    """Costs of learning a task besides the time of its epochs and evaluations, named as in `lifelong.training.costs`.

    A task may have several such records, each with some of the costs.
    """

    kind: Literal["cost"] = field(default="cost", init=False)
    task: Count
    costs: Mapping[str, Number]


@dataclass(frozen=True)
class TaskEndRecord:
    """The end of a task: it is learned, and its row of the success matrix is complete."""

    kind: Literal["task_end"] = field(default="task_end", init=False)
    task: Count
    best_epoch: Count
    seconds: Number


@dataclass(frozen=True)
class RelearnRecord:
    """Fine-tuning on a task of a finished run, from one start, in a file of its own beside the run's records.

    Attributes:
        task: Position of the task.
        start: Weights that it began with: `final`, those that acted on the task at the end of the run, or `initial`,
            those that the run began with.
        learned_error: What was measured when the run had just learned the task: the error on held-out demonstrations,
            or the share of failed rollouts.
        tolerance: By how much larger it may be for the task to count as back, see `back_limit`.
        held_out: Number of held-out demonstrations; 0 where rollouts were measured.
        rate: Learning rate.
        steps: Numbers of optimiser steps after which it was measured, ascending from 0; the last one is where the task
            was back, or where it was given up.
        errors: What was measured after these steps.
        episodes: Number of rollouts; 0 where the error was measured.
    """

    kind: Literal["relearn"] = field(default="relearn", init=False)
    task: Count
    start: Literal["final", "initial"]
    learned_error: Number
    tolerance: Number
    held_out: Count
    rate: Number
    steps: tuple[Count, ...]
    errors: tuple[Number, ...]
    seconds: Number
    episodes: Count = 0

    def __post_init__(self) -> None:
        if not len(self.steps) == len(self.errors) > 0:
            raise ValueError(f"{len(self.steps)} steps have {len(self.errors)} errors")

    @property
    def needed(self) -> int | None:
        """Number of steps until the task was back; None if it was given up before."""
        limit = back_limit(self.learned_error, self.tolerance, self.episodes)
        return self.steps[-1] if self.errors[-1] <= limit else None


def back_limit(learned: float, tolerance: float, episodes: int) -> float:
    """Return the largest value with which a task that is relearned counts as back.

    Args:
        learned: What was measured when it had just been learned: an error, or a share of failed rollouts.
        tolerance: The share by which an error may be larger, or the difference by which a share of rollouts may be.
        episodes: Number of rollouts; 0 for an error.
    """
    if not episodes:
        return (1 + tolerance) * learned
    return (
        math.floor((learned + tolerance) * episodes + 1e-9)
    ) / episodes  # whole rollouts, free of rounding


@dataclass(frozen=True)
class RunEndRecord:
    """The end of the run: the whole sequence is learned."""

    kind: Literal["run_end"] = field(default="run_end", init=False)
    seconds: Number
    finished: str


Record = (
    RunRecord
    | LossRecord
    | EvalRecord
    | PhaseRecord
    | DemonstrationsRecord
    | CostRecord
    | TaskEndRecord
    | RelearnRecord
    | RunEndRecord
)
RECORD_TYPES: Mapping[str, type[Record]] = {
    "run": RunRecord,
    "loss": LossRecord,
    "eval": EvalRecord,
    "phase": PhaseRecord,
    "demonstrations": DemonstrationsRecord,
    "cost": CostRecord,
    "task_end": TaskEndRecord,
    "relearn": RelearnRecord,
    "run_end": RunEndRecord,
}


def to_line(record: Record) -> bytes:
    """Return a record as one line of strict JSON, with a checksum; numbers that are not finite become null."""
    text = _text(_without_nan(asdict(record)))
    return f'{text[:-1]}, "{_CHECKSUM}": "{_checksum(text)}"}}\n'.encode()


def from_line(line: bytes) -> Record:
    """Parse a line of the file. Earlier versions wrote no checksum.

    Raises:
        ValueError: The line is not a record, or not as it was written; the message names the wrong key.
    """
    try:
        values = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from error
    kind = values.get("kind") if isinstance(values, dict) else None
    if not isinstance(kind, str) or kind not in RECORD_TYPES:
        raise ValueError(f"unknown kind of record {str(kind)[:40]!r}; valid: {', '.join(RECORD_TYPES)}")
    stated = values.pop(_CHECKSUM, None)
    if stated is not None and stated != _checksum(_text(values)):
        raise ValueError(f"a {kind!r} record that was changed: it does not have its checksum")
    del values["kind"]
    try:
        return validate(RECORD_TYPES[kind], values)
    except InvalidInputError as error:
        raise ValueError(f"a {kind!r} record: {error}") from error


def _text(values: Mapping[str, Any]) -> str:
    return json.dumps(values, ensure_ascii=False, allow_nan=False)


def _checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
