"""The conditions that decide the bits of a run besides its configuration, and what a resume under others says.

Floating-point sums depend on how they are divided: on the number of threads, the instruction set and processor for
which kernels are chosen, the libraries, the renderer. The same command gives the same bits where all of these are the
same.
"""

import hashlib
import os
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch

from lifelong.results.records import DemonstrationsRecord, RunRecord
from lifelong.results.results import Results

Conditions = Mapping[str, str]

_PACKAGES = (
    "libero_env",
    "lifelong",
    "libero_eval",
)  # whose files decide results; the facade only calls them
_ENDINGS = (".py", ".yaml", ".npz", ".json")
_VARIABLES = (
    "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS",
    "ONEDNN_MAX_CPU_ISA",
    "ATEN_CPU_CAPABILITY",
    "NVIDIA_TF32_OVERRIDE",
)
_DECISIVE_VERSIONS = (
    "python",
    "mujoco",
    "torch",
    "numpy",
    "robosuite",
    "transformers",
    "models",
    "models_digest",
)


def present_conditions(
    device: torch.device, *, processes: int = 1, renderer: str | None = None
) -> dict[str, str]:
    """Return the conditions of this process, by name.

    Args:
        device: Device of the policy.
        processes: Number of processes that train together.
        renderer: Name of the OpenGL renderer, whose images depend on it; None where nothing is drawn.
    """
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
    if not first.conditions:  # of a version that did not record them
        return []
    return [
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
        tasks: Names of the tasks.
    """
    pairs = zip(tasks, earlier.counts, later.counts, earlier.digests, later.digests, strict=True)
    names = [name for name, *values in pairs if values[0] != values[1] or values[2] != values[3]]
    if not names:
        return ""
    return (
        f"with other demonstrations than before of {few_of(names)}: what was learned before the resume was learned "
        "from the earlier ones"
    )


def few_of(names: Sequence[str], most: int = 3) -> str:
    """Return names as a list, and of more than `most` how many there are and the first ones."""
    listed = ", ".join(names[:most])
    return listed if len(names) <= most else f"{len(names)} tasks ({listed}, …)"


@cache
def source_digest() -> str:
    """Return 12 hex digits that change with the source and data of the packages, whether committed or not."""
    digest, root = hashlib.sha256(), Path(__file__).parents[2]
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
    torch_blas = "mkl" if torch.backends.mkl.is_available() else "openblas or other"
    config = np.show_config(mode="dicts") or {}
    found = config.get("Build Dependencies", {}).get("blas", {})
    return f"torch {torch_blas}, numpy {found.get('name', 'unknown')} {found.get('version', '')}".strip()
