"""Certificates: from which initial states of a task the expert reaches the goal, how fast, or why not.

Work is split into chunks of one task and 16 initial states. Results are on disk after each, so that a stopped run
resumes. The result from an initial state depends on the task and its number alone.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np

from libero_env.assets.pack import Pack, select_pack
from libero_env.demos.config import GENERATOR
from libero_env.envs.batch import BatchEnv
from libero_env.errors import LiberoError, MissingPackageError, PlacementError
from libero_env.expert import ActionNoise, Expert, Shapes
from libero_env.expert.expert import run_experts
from libero_env.mujoco_compat import mujoco
from libero_env.parallel import run_each
from libero_env.progress import progress_bar
from libero_env.sim.scene import build_scene
from libero_env.storage import read_json, write_json
from libero_env.tasks import Task
from libero_env.tasks.builder import FILE
from libero_env.validation import validate

C = TypeVar("C")

BATCH = 16  # initial states simulated together
NO_HORIZON = 1_000_000  # [steps] `run_experts` ends the attempts


@dataclass(frozen=True)
class Outcome:
    """Result of one attempt.

    Attributes:
        state: Number of the initial state.
        success: Whether the goal was reached.
        steps: Number of control steps until the goal, or until the expert was stopped.
        retries: Number of times that the expert started again.
        reason: Reason of failure; "" after a success.
    """

    state: int
    success: bool
    steps: int
    retries: int
    reason: str = ""


@dataclass(frozen=True)
class Certificate:
    """Results of one task.

    Attributes:
        task: Suite and index, such as `libero_object/3`.
        digest: Digest of what the outcomes depend on.
        outcomes: Outcomes in the order of the initial states.
    """

    task: str
    name: str
    digest: str
    outcomes: tuple[Outcome, ...] = ()

    @property
    def rate(self) -> float:
        """Share of initial states from which the goal was reached."""
        return sum(o.success for o in self.outcomes) / max(len(self.outcomes), 1)

    @property
    def lengths(self) -> list[int]:
        """Numbers of steps of the successful attempts."""
        return [o.steps for o in self.outcomes if o.success]

    def summary(self) -> dict:
        """Return the results of the task as plain values, for JSON."""
        lengths = self.lengths
        return {
            "id": self.task,
            "task": self.name,
            "states": len(self.outcomes),
            "successes": len(lengths),
            "median_length": median(lengths) if lengths else None,
            "mean_length": round(float(np.mean(lengths)), 1) if lengths else None,
            "max_length": max(lengths, default=None),
            "retries": sum(o.retries for o in self.outcomes),
            "failures": {o.state: o.reason for o in self.outcomes if not o.success},
        }


def certify(
    tasks: Sequence[Task],
    states: int = 50,
    *,
    jobs: int = 1,
    out: Path | None = None,
    assets: str | Path | None = None,
    disturb: bool = False,
    again: bool = False,
    progress: bool | None = None,
) -> list[Certificate]:
    """Run the expert from the first initial states of each task.

    Args:
        tasks: Tasks of suites, whose initial states are stored, or of files, whose initial state i is sampled with
            seed i.
        states: Number of initial states of each task, at most those that are stored.
        jobs: Number of processes; the outcomes do not depend on it. 1 runs in this process, which knows the objects
            that are registered in it.
        out: Folder with a JSON file for each task; outcomes there of the same scene and expert are not run again.
        assets: Models to use, as for `select_pack`.
        disturb: Whether to add noise to the actions, as demonstrations do.
        again: Whether to run again what is in `out`.
        progress: Whether to show a bar; None shows it where stderr is a terminal.

    Returns:
        One certificate for each task, in order. A task that cannot be built, or whose goal needs a skill that the
        expert does not have, fails from every initial state with that reason.

    Raises:
        MissingPackageError: robosuite, which supplies the robot's model, is not installed.
        LiberoError: A file in `out` is not a certificate.
    """
    pack = select_pack(assets)
    found = [Certificate(task.id, task.name, _digest(task, pack, disturb)) for task in tasks]
    ending = "-disturbed" if disturb else ""
    paths = [out / "tasks" / task.suite / f"{task.name}{ending}.json" if out else None for task in tasks]
    if not again:
        found = [_stored(path, empty) for path, empty in zip(paths, found, strict=True)]
    counts = [min(states, task.num_starts) for task in tasks]
    chunks = [(k, chunk) for k, known in enumerate(found) for chunk in _missing(known, counts[k])]
    total, left = sum(counts), sum(len(chunk) for _, chunk in chunks)
    with progress_bar(
        total=total, initial=total - left, desc="certify", unit="start", progress=progress
    ) as bar:
        arguments = [(tasks[k], numbers, pack, disturb) for k, numbers in chunks]
        for index, outcomes in run_each(attempt, arguments, jobs):
            k = chunks[index][0]
            merged = {o.state: o for o in (*found[k].outcomes, *outcomes)}
            found[k] = replace(found[k], outcomes=tuple(merged[i] for i in sorted(merged)))
            if path := paths[k]:
                write_json(path, found[k])
            bar.update(len(outcomes))
    return [replace(c, outcomes=tuple(o for o in c.outcomes if o.state < states)) for c in found]


def results(
    certificates: Sequence[Certificate], *, assets: str | Path | None = None, disturb: bool = False
) -> dict:
    """Return all results of a run and what they depend on, for `results.json`."""
    return {
        "mujoco": mujoco.__version__,
        "generator": GENERATOR,
        "assets": select_pack(assets).name,
        "disturbed": disturb,
        "successes": sum(len(c.lengths) for c in certificates),
        "total": sum(len(c.outcomes) for c in certificates),
        "tasks": [certificate.summary() for certificate in certificates],
    }


def markdown_table(certificates: Sequence[Certificate]) -> str:
    """Return a table with success, lengths, retries and the most common reasons of failure of each task."""
    lines = [
        "| task | success | steps, median (max) | retries | failures |",
        "| --- | ---: | ---: | ---: | --- |",
    ]
    for certificate in certificates:
        row = certificate.summary()
        length = f"{row['median_length']:g} ({row['max_length']})" if row["successes"] else ""
        reasons = Counter(row["failures"].values()).most_common(2)
        why = "; ".join(f"{count}x {reason}" for reason, count in reasons).replace("|", "/")
        name = " ".join([row["id"], *row["task"].replace("_", " ").replace("|", "/").split()])
        lines.append(f"| {name} | {row['successes']}/{row['states']} | {length} | {row['retries']} | {why} |")
    good, total = sum(len(c.lengths) for c in certificates), sum(len(c.outcomes) for c in certificates)
    lines.append(f"| all | **{good}/{total} = {100 * good / max(total, 1):.1f} %** | | | |")
    return "\n".join(lines) + "\n"


def write_results(
    certificates: Sequence[Certificate], out: Path, *, assets: str | None = None, disturb: bool = False
) -> None:
    """Write `results.json` and `results.md`, and print their paths.

    Args:
        certificates: Results of the tasks.
        assets: Models that were used, as for `select_pack`.
        disturb: Whether the actions had noise; the names of the files state it.
    """
    ending = "-disturbed" if disturb else ""
    written = [out / f"results{ending}.json", out / f"results{ending}.md"]
    write_json(written[0], results(certificates, assets=assets, disturb=disturb))
    written[1].write_text(markdown_table(certificates))
    print("\n".join(map(str, written)))


def _missing(certificate: Certificate, states: int) -> Iterator[list[int]]:
    done = {o.state for o in certificate.outcomes}
    missing = [i for i in range(states) if i not in done]
    for i in range(0, len(missing), BATCH):
        yield missing[i : i + BATCH]


def attempt(task: Task, states: Sequence[int], pack: Pack, disturb: bool) -> list[Outcome]:
    """Return the outcomes from some initial states, simulated together; an error is a failure with its message."""
    try:
        env, shapes = _environment(task, pack, build_scene(task.problem, pack).digest)
        number = np.resize(states, env.num_envs)
        sampled = task.suite == FILE
        env.reset(
            seed=number.tolist() if sampled else None,
            options={"reset_mask": np.arange(env.num_envs) < len(states)}
            | ({} if sampled else {"init_state": number}),
        )
        seeds = [np.random.SeedSequence([task.index, i]).spawn(2) for i in states]
        experts = [Expert(task, np.random.default_rng(seed), shapes=shapes) for seed, _ in seeds]
        noise = [ActionNoise(np.random.default_rng(seed)) for _, seed in seeds] if disturb else None
        attempts = run_experts(env, experts, noise)
    except PlacementError as error:
        if len(states) > 1:
            return [outcome for i in states for outcome in attempt(task, [i], pack, disturb)]
        return [Outcome(states[0], False, 0, 0, str(error))]
    except LiberoError as error:
        return [Outcome(i, False, 0, 0, str(error)) for i in states]
    return [Outcome(i, a.success, len(a), a.retries, a.reason) for i, a in zip(states, attempts, strict=True)]


@lru_cache(maxsize=1)
def _environment(task: Task, pack: Pack, scene: str) -> tuple[BatchEnv, Shapes]:
    env = BatchEnv(task, BATCH, num_threads=1, cameras=(), horizon=NO_HORIZON, assets=pack)
    return env, Shapes(env.scene)


def scene_digest(task: Task, pack: Pack) -> str:
    """Return the digest of a task's scene, or why it cannot be built.

    Raises:
        MissingPackageError: A package is not installed, which concerns all tasks.
    """
    try:
        return build_scene(task.problem, pack).digest
    except MissingPackageError:
        raise
    except LiberoError as error:
        return str(error)


def _digest(task: Task, pack: Pack, disturb: bool) -> str:
    """Return a digest of the task, its scene, and the versions of expert and MuJoCo, 16 hexadecimal digits."""
    parts = (task.bddl_text, scene_digest(task, pack), pack.name, GENERATOR, mujoco.__version__, disturb)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _stored(path: Path | None, empty: Certificate) -> Certificate:
    known = path and read_certificate(Certificate, path, empty.digest)
    return replace(empty, outcomes=known.outcomes) if known else empty


def read_certificate(kind: type[C], path: Path, digest: str) -> C | None:
    """Return the certificate on disk if it is of the same scene and expert.

    Raises:
        LiberoError: The file is not a certificate.
    """
    if not path.is_file():
        return None
    try:
        found = validate(kind, read_json(path))
    except LiberoError as error:
        raise LiberoError(f"{path} is not a certificate ({error}); remove it, or run with --again") from error
    return found if found.digest == digest else None
