"""Certificates of perturbed tasks: whether the expert solves what was drawn, and which draw it solves otherwise.

The expert reads the state of the simulation, so that only kinds that change physics, start or actions matter to it.
Results are on disk after each task and perturbation, so that a stopped run resumes.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.assets.pack import select_pack
from libero_env.demos.config import GENERATOR
from libero_env.design.certify import NO_HORIZON, read_certificate, scene_digest
from libero_env.envs.batch import BatchEnv
from libero_env.errors import InvalidInputError, LiberoError, PlacementError
from libero_env.expert import Expert, Shapes
from libero_env.expert.expert import run_experts
from libero_env.mujoco_compat import mujoco
from libero_env.parallel import run_each
from libero_env.perturbations.kinds import trying
from libero_env.perturbations.perturbation import Perturbation
from libero_env.progress import progress_bar
from libero_env.storage import write_json
from libero_env.tasks import Task

_FORMAT = 2  # of the files; those of another are made again
REDRAWS = 3  # further draws of what the expert does not solve


@dataclass(frozen=True)
class PerturbedCertificate:
    """Results of one task under one perturbation.

    Attributes:
        task: Id of the task without perturbations.
        perturbation: The perturbation as text.
        digest: Digest of what the results depend on.
        solved: Index of an initial state -> number of the first draw from which the expert reaches the goal.
        at_first: Number of initial states from which the expert solves the first draw.
        failures: Index of an initial state -> why the expert reaches it from none of the draws.
        drawn_again: Number of draws of the whole task that the expert did not solve from most of the starts.
        impossible: Why the task cannot be perturbed in this way; "" where it can.
    """

    task: str
    perturbation: str
    digest: str
    solved: Mapping[str, int] = field(default_factory=dict)
    at_first: int = 0
    failures: Mapping[str, str] = field(default_factory=dict)
    drawn_again: int = 0
    impossible: str = ""

    @property
    def starts(self) -> int:
        """Number of initial states."""
        return len(self.solved) + len(self.failures)

    @property
    def redraws(self) -> int:
        """Number of draws that were made again."""
        return self.drawn_again + sum(self.solved.values())

    def attempts(self, one: Perturbation) -> dict[str, int]:
        """Return the numbers of the draws to use, by their names: 0, the first, where the expert solves none."""
        own = {**dict.fromkeys(self.failures, 0), **self.solved, "": self.drawn_again}
        return {one.sample_name(self.task, start): n for start, n in own.items()}


def certify_perturbed(
    tasks: Sequence[Task],
    perturbations: Sequence[Perturbation],
    starts: int = 10,
    *,
    redraws: int = REDRAWS,
    jobs: int = 1,
    out: Path,
    again: bool = False,
) -> list[PerturbedCertificate]:
    """Run the expert on perturbed tasks, from the first initial states of each.

    Args:
        perturbations: Perturbations, each by itself.
        starts: Number of initial states of each task, at most those that are stored.
        redraws: Number of further draws where the expert fails.
        jobs: Number of processes; the results do not depend on it.
        out: Folder of the results, a file for each task and perturbation.
        again: Whether to run again what is there.

    Returns:
        A certificate for each task and perturbation, in order.

    Raises:
        LiberoError: A file in `out` is not a certificate.
    """
    units = [(task, one) for task in tasks for one in perturbations]
    found: dict[int, PerturbedCertificate] = {}
    counts = [min(starts, task.num_starts) for task, _ in units]
    for k, (task, one) in enumerate(() if again else units):
        digest = _digest(task, one, counts[k], redraws)
        if stored := read_certificate(PerturbedCertificate, _path(out, task, one), digest):
            found[k] = stored
    left = [k for k in range(len(units)) if k not in found]
    with progress_bar(total=len(units), initial=len(found), desc="certify", unit="variant") as bar:
        arguments = [(*units[k], range(counts[k]), redraws) for k in left]
        for index, certificate in run_each(attempt_perturbed, arguments, jobs):
            k = left[index]
            found[k] = certificate
            write_json(_path(out, *units[k]), certificate)
            bar.update()
    return [found[k] for k in range(len(units))]


def attempt_perturbed(
    task: Task, one: Perturbation, starts: Sequence[int], redraws: int = REDRAWS
) -> PerturbedCertificate:
    """Return the certificate of a task under a perturbation.

    What the expert does not solve is drawn again for the start; where it solves less than half of the starts, and the
    perturbation is drawn for the whole task, that is drawn again first.
    """
    digest, whole = _digest(task, one, len(starts), redraws), 0
    redraws = redraws if one.definition.is_sampled else 0
    try:
        outcomes = _outcomes(task, one, starts, 0, whole)
        at_first = _won(outcomes)
        while one.definition.layer == "problem" and whole < redraws and 2 * _won(outcomes) < len(starts):
            whole += 1
            outcomes = _outcomes(task, one, starts, 0, whole)
    except InvalidInputError as error:
        return PerturbedCertificate(task.id, str(one), digest, impossible=str(error))
    solved = {start: 0 for start, reason in outcomes.items() if not reason}
    for attempt in range(1, redraws + 1):
        pending = [start for start in starts if start not in solved]
        if not pending:
            break
        outcomes |= _outcomes(task, one, pending, attempt, whole)
        solved |= {start: attempt for start in pending if not outcomes[start]}
    failures = {str(start): outcomes[start] for start in starts if start not in solved}
    by_start = {str(start): solved[start] for start in starts if start in solved}
    return PerturbedCertificate(task.id, str(one), digest, by_start, at_first, failures, whole)


def _won(outcomes: Mapping[int, str]) -> int:
    return sum(not reason for reason in outcomes.values())


def _outcomes(
    task: Task, one: Perturbation, starts: Sequence[int], attempt: int, whole: int
) -> dict[int, str]:
    """Return why the expert fails from each start with the draws of a number; "" where it succeeds."""
    attempts = {one.sample_name(task.id, start): attempt for start in starts} | {
        one.sample_name(task.id): whole
    }
    try:
        with trying(attempts):
            options: dict[str, Any] = {"num_threads": 1, "cameras": (), "horizon": NO_HORIZON}
            with BatchEnv(task, len(starts), perturb=[one], **options) as env:
                env.reset(options={"init_state": list(starts)})
                seeds = [np.random.default_rng([task.index, start]) for start in starts]
                shapes = Shapes(env.scene)
                found = run_experts(env, [Expert(env.task, seed, shapes=shapes) for seed in seeds])
    except InvalidInputError:
        raise
    except PlacementError as error:
        if len(starts) == 1:
            return {starts[0]: str(error)}
        return {k: v for start in starts for k, v in _outcomes(task, one, [start], attempt, whole).items()}
    except LiberoError as error:
        return dict.fromkeys(starts, str(error))
    return {start: "" if a.success else a.reason for start, a in zip(starts, found, strict=True)}


def shares_table(
    certificates: Sequence[PerturbedCertificate], perturbations: Sequence[Perturbation]
) -> list[str]:
    """Return a line for each perturbation: how much of it the expert solves at first, and after draws were repeated."""
    lines = [
        f"{'perturbation':22} {'starts':>6} {'at first':>9} {'in the end':>11} {'redraws':>8}  not possible"
    ]
    for one in perturbations:
        own = [c for c in certificates if c.perturbation == str(one)]
        total, impossible = sum(c.starts for c in own), [c.task for c in own if c.impossible]
        share = [
            100 * n / max(total, 1) for n in (sum(c.at_first for c in own), sum(len(c.solved) for c in own))
        ]
        again = sum(c.redraws for c in own)
        words = f"{len(impossible)} of {len(own)} tasks" if impossible else ""
        lines.append(f"{one!s:22} {total:6d} {share[0]:8.1f}% {share[1]:10.1f}% {again:8d}  {words}".rstrip())
    return lines


def _path(folder: Path, task: Task, one: Perturbation) -> Path:
    return folder / task.suite / task.name / f"{one}.json"


def _digest(task: Task, one: Perturbation, starts: int, redraws: int) -> str:
    pack = select_pack()
    what = (_FORMAT, task.bddl_text, scene_digest(task, pack), pack.name, str(one), one.definition.at_one)
    parts = (*what, starts, redraws, GENERATOR, mujoco.__version__)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]
