"""Where results come from: the configuration, source and versions of a run, and all else that decides its bits.

Floating-point sums depend on how they are divided: on the number of threads, the instruction set and processor for
which kernels are chosen, the libraries, the renderer. The same command gives the same bits where all of these are the
same.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from libero_env.text import flatten
from lifelong.results.records import DemonstrationsRecord, RunRecord
from lifelong.results.results import Results

if TYPE_CHECKING:
    import torch

# Keys that may differ between the start of a run and its resumption, because they change no result.
VOLATILE = (
    "device",
    "progress",
    "resume",
    "run_id",
    "runs_dir",
    "threads",
    "tracker",
    "data.folder",  # what was learned from is recorded by digest
    "data.memory",
    "eval.beside",
    "eval.open_environments",
    "eval.sim_threads",
    "language.cache_dir",
    "eval.shift",  # evaluations besides all others
)
VERSIONED_PACKAGES = ("libero-lifelong", "mujoco", "torch", "numpy", "gymnasium", "h5py", "transformers")
# whose files decide results; the facade only calls them
_PACKAGES = ("libero_env", "lifelong", "libero_eval")
_ENDINGS = (".py", ".yaml", ".npz", ".json")
_VARIABLES = (
    *("MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "ONEDNN_MAX_CPU_ISA", "ATEN_CPU_CAPABILITY"),
    "NVIDIA_TF32_OVERRIDE",
)
_DECISIVE_VERSIONS = ("python", "mujoco", "torch", "numpy", "transformers", "models", "models_digest")
_ROOT = Path(__file__).parents[2]


def result_relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a configuration that affect results, by dotted key; not on which shelf an algorithm is."""
    found = {k: v for k, v in flatten(config).items() if not _is_volatile(k)}
    if isinstance(target := found.get("algo._target_"), str):
        found["algo._target_"] = target.replace("lifelong.algorithms.contrib.", "lifelong.algorithms.")
    return found


def _is_volatile(key: str) -> bool:
    return f"{key}.".startswith(tuple(f"{volatile}." for volatile in VOLATILE))


def config_digest(config: Mapping[str, Any]) -> str:
    """Return 16 hex digits that change with whatever affects the results of a configuration."""
    text = json.dumps(result_relevant(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def start_record(*, config: Mapping[str, Any], overrides: Sequence[str] = (), **facts: Any) -> RunRecord:
    """Return the record of a run that starts now, on this machine.

    Args:
        config: Resolved configuration as plain data, whose digest is recorded.
        overrides: Those of the command, of which those that change no result are left out.
        facts: Other fields of `RunRecord`; those that are tuples may be any sequence.
    """
    columns = ("tasks", "instructions", "held_out", "perturbed", "group_sizes")
    fields: Any = {name: tuple(value) if name in columns else value for name, value in facts.items()}
    return RunRecord(
        config_digest=config_digest(config),
        versions=installed_versions(),
        commit=source_commit(),
        cpu_count=os.cpu_count() or 1,
        started=utc_now(),
        overrides=tuple(word for word in overrides if not _is_volatile(word.lstrip("+").partition("=")[0])),
        **fields,
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
    if not (_ROOT / ".git").exists():
        return None
    try:
        commit, changes = (_git("rev-parse", "HEAD"), _git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None
    return commit + ("+changes" if changes else "")


def _git(*args: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(_ROOT), *args], capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()


def present_conditions(
    device: "torch.device", *, processes: int = 1, renderer: str | None = None
) -> dict[str, str]:
    """Return the conditions of this process, by name.

    Args:
        processes: Number of processes that train together.
        renderer: Name of the OpenGL renderer, whose images depend on it; None where nothing is drawn.
    """
    import torch

    found = {
        "threads": str(torch.get_num_threads()),
        "processes": str(processes),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "processor": _processor(),
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "blas": _blas(),
        "source": source_digest(),
    }
    if device.type == "cuda":
        found |= {"cuda": str(torch.version.cuda), "cudnn": str(torch.backends.cudnn.version())}
        tf32 = {"convolutions": torch.backends.cudnn, "products": torch.backends.cuda.matmul}
        found["tf32"] = ", ".join(name for name, kind in tf32.items() if kind.allow_tf32) or "none"
    if renderer is not None:
        found["renderer"] = renderer
    return found | {name: os.environ[name] for name in _VARIABLES if name in os.environ}


def recorded_threads(results: Results) -> int | None:
    """Return the number of PyTorch's threads that a run was started with; None where it is not recorded."""
    starts = results.of(RunRecord)
    threads = starts[0].conditions.get("threads", "") if starts else ""
    return int(threads) if threads.isdecimal() and 0 < int(threads) < 4096 else None


def changed_conditions(first: RunRecord, later: RunRecord) -> list[str]:
    """Return what differs between two starts of a run that decides its bits, such as `torch 2.12.0 -> 2.13.0`."""
    was, now = all_conditions(first), all_conditions(later)
    pairs = zip(first.instructions, later.instructions, strict=True)  # of task files, which may be edited
    return [f"instruction {old!r} -> {new!r}" for old, new in pairs if old != new] + [
        f"{name.replace('_', ' ')} {was.get(name, 'none')} -> {now.get(name, 'none')}"
        for name in {**was, **now}
        if was.get(name) != now.get(name)
    ]


def resume_notes(results: Results) -> list[str]:
    """Return a sentence for each resume of a run under other conditions, or with other demonstrations, than before."""
    starts, notes = results.of(RunRecord), []
    for before, after in zip(starts, starts[1:], strict=False):
        if changes := changed_conditions(before, after):
            notes.append(
                f"Resumed {after.started.replace('T', ' ').replace('+00:00', ' UTC')} under other conditions "
                f"({', '.join(changes)}): from there on, bits differ from those of an uninterrupted run."
            )
    found = results.of(DemonstrationsRecord)
    for earlier, later in zip(found, found[1:], strict=False):
        if other := changed_demonstrations(earlier, later, results.run.tasks):
            notes.append(f"Resumed {other}.")
    return notes


def changed_demonstrations(
    earlier: DemonstrationsRecord, later: DemonstrationsRecord, tasks: Sequence[str]
) -> str:
    """Return what a resume with other demonstrations says, without a full stop; "" where they are the same ones.

    Args:
        earlier: Demonstrations before.
        later: Demonstrations after.
    """
    pairs = zip(tasks, earlier.counts, later.counts, earlier.digests, later.digests, strict=True)
    names = [name for name, *values in pairs if values[0] != values[1] or values[2] != values[3]]
    if not names:
        return ""
    return (
        f"with other demonstrations than before of {few_of(names)}: what was learned before the resume was learned "
        "from the earlier ones"
    )


def few_of(names: Sequence[str], most: int = 4) -> str:
    """Return names as a list, and of more than `most` the first ones and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


@cache
def source_digest() -> str:
    """Return 12 hex digits that change with the source and data of the packages, whether committed or not."""
    digest, root = hashlib.sha256(), _ROOT
    for package in _PACKAGES:
        for file in sorted((root / package).rglob("*")):
            if file.suffix in _ENDINGS and file.is_file():
                digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:12]


def all_conditions(record: RunRecord) -> dict[str, str]:
    """Return everything besides the configuration that decides the bits of what a process does, by name."""
    versions = {name: record.versions[name] for name in _DECISIVE_VERSIONS if name in record.versions}
    return {**record.conditions, **versions}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _blas() -> str:
    """Return the libraries of matrix products of PyTorch and NumPy."""
    import torch

    torch_blas = "mkl" if torch.backends.mkl.is_available() else "openblas or other"
    config = np.show_config(mode="dicts") or {}
    found = config.get("Build Dependencies", {}).get("blas", {})
    return f"torch {torch_blas}, numpy {found.get('name', 'unknown')} {found.get('version', '')}".strip()
