"""How much memory there is, as the kernel and control groups say it."""

import resource
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from libero_env import memory

GIB = 1 << 30


@pytest.fixture
def machine(tmp_path: Path, monkeypatch):
    """A machine of 8 GiB and 1 GiB of swap, of which 6 GiB are free; a function that writes another of its files."""
    proc, groups = tmp_path / "proc", tmp_path / "groups"

    def write(name: str, text: object) -> None:
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")

    monkeypatch.setattr(memory, "_PROC", proc)
    monkeypatch.setattr(memory, "_GROUPS", groups)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=8 * GIB, available=6 * GIB))
    monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(total=GIB))
    return write


def test_without_limits_it_is_the_machines(machine):
    assert memory.host_memory() == (6 * GIB, 8 * GIB)
    assert memory.memory_limit() == 9 * GIB


@pytest.mark.parametrize("inside", ["", "/user.slice/job"])
def test_groups_of_version_two_limit_what_is_inside_of_them(machine, inside):
    machine("proc/self/cgroup", f"0::/user.slice{inside}")
    machine("groups/memory.max", "max")
    machine("groups/user.slice/memory.max", 4 * GIB)
    machine("groups/user.slice/memory.current", 3 * GIB)
    machine("groups/user.slice/memory.stat", f"anon 5\ninactive_file {GIB // 2}\nactive_file 7")
    assert memory.host_memory() == (3 * GIB // 2, 4 * GIB)
    assert memory.memory_limit() == 4 * GIB


def test_groups_of_version_one_are_found_where_only_their_root_is_seen(machine):
    machine("proc/self/cgroup", "5:cpu,cpuacct:/\n4:memory:/docker/abc\n0::/")
    machine("groups/memory/memory.limit_in_bytes", 2 * GIB)
    machine("groups/memory/memory.usage_in_bytes", GIB)
    machine("groups/memory/memory.stat", "cache 9")
    assert memory.host_memory() == (GIB, 2 * GIB)
    assert memory.memory_limit() == 2 * GIB


def test_more_than_a_limit_leaves_nothing(machine):
    machine("proc/self/cgroup", "0::/")
    machine("groups/memory.max", GIB)
    machine("groups/memory.current", 2 * GIB)
    assert memory.host_memory()[0] == 0


def test_the_limit_of_the_process_counts(machine, monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (3 * GIB, resource.RLIM_INFINITY))
    assert memory.memory_limit() == 3 * GIB


def test_this_machine_is_measured():
    free, total = memory.host_memory()
    assert 0 < free < total <= psutil.virtual_memory().total and 1 << 28 < memory.memory_limit() < 1 << 50
