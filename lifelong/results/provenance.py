"""Where results come from: when a run started, from which source, with which versions."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from lifelong.results.coverage import MatrixCells
from lifelong.results.records import RunRecord
from lifelong.results.run_directory import config_digest
from lifelong.stats.metrics import Transfer

VERSIONED_PACKAGES = (
    "libero-lifelong",
    "mujoco",
    "torch",
    "numpy",
    "robosuite",
    "gymnasium",
    "h5py",
    "transformers",
)

_SOURCE = Path(__file__).parents[2]


def start_record(
    *,
    algo: str,
    benchmark: str,
    policy: str,
    seed: int,
    preset: str,
    tasks: Sequence[str],
    instructions: Sequence[str],
    config: Mapping[str, Any],
    group_sizes: Sequence[int] = (),
    conditions: Mapping[str, str] | None = None,
    cells: MatrixCells = "all",
    transfer: Transfer = "cross_fitted",
    perturbed: Sequence[str] = (),
    backend: str = "mujoco",
) -> RunRecord:
    """Return the record of a run that starts now, on this machine.

    Args:
        algo: Name of the algorithm's configuration.
        benchmark: Name of the benchmark's configuration.
        policy: Name of the policy's configuration.
        seed: Seed of the run.
        preset: Name of the preset.
        tasks: Names of the tasks in learning order.
        instructions: Instructions of the tasks, in the same order.
        config: Resolved configuration as plain data, whose digest is recorded.
        group_sizes: Number of tasks in each group that is one step of the sequence; () for one at a time.
        conditions: What decides the bits of its results, see `lifelong.results.conditions`.
        cells: Cells of the success matrix that are measured.
        transfer: Estimate of forward transfer, see `lifelong.stats.metrics`.
        perturbed: Perturbations under which each task is learned and evaluated, as text; () for none at all.
        backend: Name of the back end of rollouts.
    """
    equal = len(set(group_sizes)) < 2  # written as earlier versions did
    return RunRecord(
        algo=algo,
        benchmark=benchmark,
        policy=policy,
        seed=seed,
        preset=preset,
        tasks=tuple(tasks),
        instructions=tuple(instructions),
        config_digest=config_digest(config),
        versions=installed_versions(),
        commit=source_commit(),
        cpu_count=os.cpu_count() or 1,
        started=utc_now(),
        group_size=group_sizes[0] if group_sizes and equal else 1,
        conditions=conditions or {},
        cells=cells,
        backend=backend,
        group_sizes=() if equal else tuple(group_sizes),
        transfer=transfer,
        perturbed=tuple(perturbed),
    )


def utc_now() -> str:
    """Return the time as ISO 8601 with seconds, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def installed_versions(assets: str | None = None) -> dict[str, str]:
    """Return the versions of Python and of the packages results depend on.

    `models` names the pack of objects, and `models_digest` changes with its files.

    Args:
        assets: Pack as an argument of `libero_env.assets.pack.select_pack`; None for the user's choice.
    """
    from libero_env.assets.pack import select_pack

    versions = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in VERSIONED_PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    pack = select_pack(assets)
    return {**versions, "models": pack.name, "models_digest": pack.digest}


def source_commit() -> str | None:
    """Return the git commit of this source tree, with "+changes" if it was edited; None outside a checkout."""
    if not (_SOURCE / ".git").exists():
        return None
    try:
        commit, changes = (_git("rev-parse", "HEAD"), _git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None
    return commit + ("+changes" if changes else "")


def _git(*args: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(_SOURCE), *args], capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()
