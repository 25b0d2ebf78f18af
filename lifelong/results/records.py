"""Records of a run: frozen values, one JSON line each. Tasks are positions in the sequence."""

import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import accumulate
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, WrapValidator

from libero_env.errors import InvalidInputError
from libero_env.sim.causes import Failure
from libero_env.sim.costs import Costs
from libero_env.text import json_safe
from libero_env.validation import validate
from lifelong.results.cells import MatrixCells, measured_tasks
from lifelong.stats.metrics import Transfer

_CHECKSUM = "crc32"

Count = Annotated[int, Field(ge=0, le=10**9)]
Phase = Literal["curve", "matrix", "unseen", "initial", "shift"]
Number = Annotated[float, WrapValidator(lambda value, parse: math.nan if value is None else parse(value))]


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One start of the process; a resumed run has several. The first names the run."""

    kind: Literal["run"] = "run"
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
    conditions: Mapping[str, str] = field(default_factory=dict)  # see `lifelong.results.provenance`
    cells: MatrixCells = "all"  # of the success matrix, which are measured
    cells_share: Annotated[float, Field(gt=0, le=1)] = 1.0  # of each row, where they are sampled
    cells_seed: Count | None = None  # by which they are drawn; None: one drawing for all runs, as of old
    # number of tasks in each group that is one step of the sequence; () for one task at a time
    group_sizes: tuple[Annotated[int, Field(ge=1)], ...] = ()
    transfer: Transfer = "cross_fitted"  # estimate of forward transfer, see `lifelong.stats.metrics`
    # perturbations of each task, in learning and evaluation; () for none at all
    perturbed: tuple[str, ...] = ()
    backend: str = "mujoco"  # of the rollouts: mujoco or warp
    data_seed: Count | None = None  # of the demonstrations, where the configuration names one
    overrides: tuple[str, ...] = ()  # of the command, but for what changes no result
    held_out: tuple[str, ...] = ()  # names of the tasks that are evaluated and never learned

    def __post_init__(self) -> None:
        if not len(self.tasks) == len(self.instructions) > 0:
            raise ValueError(f"a run of {len(self.tasks)} tasks has {len(self.instructions)} instructions")
        if len(self.perturbed) not in (0, len(self.tasks)):
            raise ValueError(f"a run of {len(self.tasks)} tasks has {len(self.perturbed)} perturbations")
        if self.group_sizes and sum(self.group_sizes) != len(self.tasks):
            raise ValueError(
                f"{len(self.tasks)} tasks are not groups of {', '.join(map(str, self.group_sizes))}"
            )

    @property
    def groups(self) -> tuple[range, ...]:
        """Positions of the tasks in each group that is one step of the sequence."""
        sizes = self.group_sizes or (1,) * len(self.tasks)
        return tuple(range(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True))

    @property
    def demonstrations_seed(self) -> int:
        """Seed of the demonstrations: 0 where the configuration names none, as the expert then records with."""
        return self.data_seed or 0

    @property
    def has_base_stage(self) -> bool:
        """Whether more tasks were learned together first than in any later group."""
        return len(self.groups) > 1 and len(self.groups[0]) > max(map(len, self.groups[1:]))

    def row(self, stage: Sequence[int]) -> Sequence[int]:
        """Return the tasks that are measured after a stage, see `measured_tasks`."""
        return measured_tasks(self.cells, stage, len(self.tasks), self.cells_share, self.cells_seed)

    def group(self, task: int) -> range:
        """Return the positions of the tasks in a task's group."""
        return next(group for group in self.groups if task in group)


@dataclass(frozen=True, kw_only=True)
class LossRecord:
    """The mean training loss of one epoch (epochs count from 1) and its wall time."""

    kind: Literal["loss"] = "loss"
    task: Count
    epoch: Count
    loss: Number
    seconds: Number


@dataclass(frozen=True, kw_only=True)
class CollectionRecord:
    """Episodes of the policy itself, with drawn actions, that it learned from in one epoch.

    Attributes:
        epoch: The epoch, from 1.
        episodes: Number of episodes.
        successes: How many of them succeeded.
        steps: Number of their control steps.
        groups: Number of initial states from which some succeeded and some did not.
        entropy: Mean of the negative log-probability of the actions, [nat].
        seconds: Wall time.
    """

    kind: Literal["collection"] = "collection"
    task: Count
    epoch: Count
    episodes: Count
    successes: Count
    steps: Count
    groups: Count
    entropy: Number
    seconds: Number


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Outcomes of episodes on one task.

    An episode that a simulation error ended is neither a success nor a failure: only `simulation_errors` has it.

    Attributes:
        init_states: Initial state of each episode.
        successes: Whether each reached the goal.
        lengths: Number of control steps of each.
        atoms: Atoms of the goal, such as `(On plate_1 stove_1)`; empty if they were not measured.
        atoms_ever: Whether each atom held at any time after the policy began to act, (episodes, atoms).
        atoms_at_end: Whether each atom held at the end, (episodes, atoms).
        simulation_errors: Initial state and reason of each episode that a simulation error ended.
        limits_reached: How often a simulation reached a limit of the solver and went on, by its name (Warp).
        failures: Why each episode failed; None of those that did not, or where it was not seen.
        costs: What each cost; None where it was not seen.
    """

    init_states: tuple[Count, ...]
    successes: tuple[bool, ...]
    lengths: tuple[Count, ...]
    atoms: tuple[str, ...] = ()
    atoms_ever: tuple[tuple[bool, ...], ...] = ()
    atoms_at_end: tuple[tuple[bool, ...], ...] = ()
    simulation_errors: tuple[tuple[Count, str], ...] = ()
    limits_reached: tuple[tuple[str, Count], ...] = ()
    failures: tuple[Failure | None, ...] = ()
    costs: tuple[Costs | None, ...] = ()

    # further columns, with an entry for each episode or none at all
    OPTIONAL: ClassVar[tuple[str, ...]] = ("failures", "costs")
    OF_ATOMS: ClassVar[tuple[str, ...]] = ("atoms_ever", "atoms_at_end")

    def shape_errors(self) -> list[str]:
        """Return what is wrong with the sizes of the columns."""
        count, errors = len(self.init_states), []
        if not count and not self.simulation_errors:
            errors.append("there are no episodes")
        for name in ("successes", "lengths", *self.OPTIONAL, *self.OF_ATOMS):
            entries = getattr(self, name)
            optional = name in self.OPTIONAL or (name in self.OF_ATOMS and not self.atoms)
            if len(entries) != count and (entries or not optional):
                errors.append(f"{name} has {len(entries)} entries, init_states has {count}")
            if name in self.OF_ATOMS and {len(row) for row in entries} - {len(self.atoms)}:
                errors.append(f"{name} needs a column for each of the {len(self.atoms)} atoms")
        return errors

    @property
    def rate(self) -> float:
        """Success rate of the episodes."""
        return sum(self.successes) / len(self.successes)

    @property
    def error_note(self) -> str:
        """Number of episodes that simulation errors ended, as text; empty if there are none."""
        failed, count = len(self.simulation_errors), len(self.simulation_errors) + len(self.init_states)
        return f"{failed} of {count} ended by a simulation error, not counted" if failed else ""


@dataclass(frozen=True, kw_only=True)
class EvalRecord(Episodes):
    """Rollouts on one task: `phase` "curve" while learning it, "matrix" after learning task `learned`.

    Rollouts on a task that is learned later than `learned`, or never (held out, at a position after those
    of the run), have the phase "unseen"; those before the first task, "initial" (`learned` and `epoch` are 0).

    Rollouts under a held-out shift (`eval.shift`) after learning task `learned` have the phase "shift"; all others are
    under the perturbations of the run's task, see `RunRecord.perturbed`.

    Rollouts that would repeat earlier ones to the bit are not run: their record is a copy, with the key of the one it
    is a copy of, and takes 0 seconds.

    Attributes:
        epoch: Number of epochs trained on task `learned` when the policy was frozen (0: zero-shot).
        atoms_at_start: Whether each atom held before the policy acted, (episodes, atoms).
        decided_by: Digest of all that the rollouts depend on; empty where they also depend on random draws.
        same_as: Phase, learned and epoch of the original, if it is a copy.
        shift: Perturbations of the shift, as text.
    """

    kind: Literal["eval"] = "eval"
    phase: Phase
    learned: Count
    epoch: Count
    task: Count
    seconds: Number
    atoms_at_start: tuple[tuple[bool, ...], ...] = ()
    decided_by: str = ""
    same_as: tuple[Phase, Count, Count] | None = None
    shift: str = ""

    OF_ATOMS: ClassVar[tuple[str, ...]] = ("atoms_at_start", "atoms_ever", "atoms_at_end")

    def __post_init__(self) -> None:
        errors = self.shape_errors()
        if not self.init_states:
            errors.append("no episode counts")
        if self.phase not in get_args(Phase):
            errors.append(
                f"phase of an evaluation is one of {', '.join(get_args(Phase))}, not {self.phase!r}"
            )
        if (self.phase == "shift") != bool(self.shift):
            errors.append(f"an evaluation of phase {self.phase!r} has the shift {self.shift!r}")
        if errors:
            raise ValueError(errors[0])

    @property
    def outcome(self) -> tuple[Any, ...]:
        """What the rollouts came to, without where and when they were run."""
        atoms = (self.atoms, self.atoms_at_start, self.atoms_ever, self.atoms_at_end)
        return (self.successes, self.lengths, self.init_states, self.simulation_errors, *atoms)


@dataclass(frozen=True, kw_only=True)
class PhaseRecord:
    """Wall time of something that is neither a training epoch nor an evaluation, such as "demos"."""

    kind: Literal["phase"] = "phase"
    phase: str
    seconds: Number


@dataclass(frozen=True, kw_only=True)
class DemonstrationsRecord:
    """The demonstrations that the process which started last learns from, by task.

    Attributes:
        counts: Number of demonstrations.
        generators: What recorded them, such as `scripted-expert-1`; "" where their file does not say.
        digests: Digest of their states and actions, see `libero_env.demos.DemoOrigin`.
        models: Models that their images show; none in records of before they were noted.
        labels: Whether the actions that are learned are `intended` or `executed`; none in such records.
    """

    kind: Literal["demonstrations"] = "demonstrations"
    counts: tuple[Count, ...]
    generators: tuple[str, ...]
    digests: tuple[str, ...]
    models: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.counts) == len(self.generators) == len(self.digests) > 0:
            raise ValueError(
                f"{len(self.counts)} counts have {len(self.generators)} generators and {len(self.digests)} digests"
            )


@dataclass(frozen=True, kw_only=True)
class CostRecord:
    """Costs of learning a task besides the time of its epochs and evaluations, named as in `lifelong.training.costs`.

    A task may have several such records, each with some of the costs.
    """

    kind: Literal["cost"] = "cost"
    task: Count
    costs: Mapping[str, Number]


@dataclass(frozen=True, kw_only=True)
class TaskEndRecord:
    """The end of a task: it is learned, and its row of the success matrix is complete."""

    kind: Literal["task_end"] = "task_end"
    task: Count
    best_epoch: Count
    seconds: Number


@dataclass(frozen=True, kw_only=True)
class RelearnRecord:
    """Fine-tuning on a task of a finished run, from one start, in a file of its own beside the run's records.

    Attributes:
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
        weights: Digest of the initial weights, where it began with them; otherwise empty.
    """

    kind: Literal["relearn"] = "relearn"
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
    weights: str = ""

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


@dataclass(frozen=True, kw_only=True)
class RunEndRecord:
    """The end of the run: the whole sequence is learned."""

    kind: Literal["run_end"] = "run_end"
    seconds: Number
    finished: str


Record = (
    RunRecord
    | LossRecord
    | CollectionRecord
    | EvalRecord
    | PhaseRecord
    | DemonstrationsRecord
    | CostRecord
    | TaskEndRecord
    | RelearnRecord
    | RunEndRecord
)
_KINDS: Mapping[str, type[Record]] = {record.kind: record for record in get_args(Record)}


def to_line(record: Record) -> bytes:
    """Return a record as one line of strict JSON, with a checksum; numbers that are not finite become null."""
    return signed_line(asdict(record))


def signed_line(values: Mapping[str, Any]) -> bytes:
    """Return plain data as such a line."""
    text = _text(json_safe(values))
    return f'{text[:-1]}, "{_CHECKSUM}": "{_checksum(text)}"}}\n'.encode()


def from_line(line: bytes) -> Record:
    """Parse a line of the file.

    Raises:
        ValueError: The line is not a record, or not as it was written; the message names the wrong key.
    """
    try:
        values = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from error
    kind = values.get("kind") if isinstance(values, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"unknown kind of record {str(kind)[:40]!r}; valid: {', '.join(_KINDS)}")
    if values.pop(_CHECKSUM, None) != _checksum(_text(values)):
        raise ValueError(f"a {kind!r} record that was changed: it does not have its checksum")
    try:
        record: Record = validate(_KINDS[kind], values)
    except InvalidInputError as error:
        raise ValueError(f"a {kind!r} record: {error}") from error
    return record


def _text(values: Mapping[str, Any]) -> str:
    return json.dumps(values, ensure_ascii=False, allow_nan=False)


def _checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"
