"""How much memory there is: of the machine, and what control groups and limits leave of it to this process."""

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

from libero_env.errors import LiberoError
from libero_env.text import show_bytes

_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")
_NAMES = {  # version of control groups -> files with the limit and with what is used
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes"),
    2: ("memory.max", "memory.current"),
}


def host_memory() -> tuple[int, int]:
    """Return the available and the total bytes of host memory, or of the container if it has a limit."""
    groups, machine = list(_groups()), psutil.virtual_memory()
    total = min([machine.total, *(limit for limit, _ in groups)])
    free = [machine.available, total, *(amount for _, amount in groups if amount is not None)]
    return max(0, min(free)), total


def memory_limit() -> int:
    """Return the most bytes that this process can have: of the machine with its swap, its container, its limits."""
    limits = [psutil.virtual_memory().total + psutil.swap_memory().total, *(limit for limit, _ in _groups())]
    with suppress(ImportError):  # Windows has no limits of processes
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        limits += [] if soft == resource.RLIM_INFINITY else [soft]
    return min(limits)


def require_memory(needed: float, what: str, remedy: str, error: type[LiberoError] = LiberoError) -> None:
    """Check that memory is available before it is asked for; a process that takes too much is killed.

    Args:
        needed: Estimate of what is needed, [bytes].
        what: What it is needed for.
        remedy: What to change.

    Raises:
        LiberoError: There is less; the message has both figures. Or `error`.
    """
    there, _ = host_memory()
    if needed > there:
        raise error(
            f"{what} needs about {show_bytes(needed)} of memory; {show_bytes(there)} are free: {remedy}"
        )


def _groups() -> Iterator[tuple[int, int | None]]:
    """Yield the limits of this process's control groups and of those around them, each with what is free of it."""
    for line in _read(_PROC / "self" / "cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        root, (limit, used) = _GROUPS / controllers, _NAMES[1 if controllers else 2]
        inside = root / path.lstrip("/")
        for folder in (inside, *inside.parents):
            if folder.is_relative_to(root) and (most := _read(folder / limit)).isdecimal():
                yield int(most), _free(folder, int(most), _read(folder / used))


def _free(folder: Path, limit: int, used: str) -> int | None:
    """Return what is free of a control group's limit; None where the group does not say what is used."""
    if not used.isdecimal():
        return None
    # files that were read count as used; the system drops them first
    cached = re.search(r"^(?:total_)?inactive_file (\d+)$", _read(folder / "memory.stat"), re.MULTILINE)
    return limit - int(used) + (int(cached.group(1)) if cached else 0)


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip()
    except OSError:
        return ""
