"""Fixtures shared by all tests."""

import contextlib
import ctypes
import gc
import importlib
import os
import resource
import sys
from collections import Counter, UserDict
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from libero_env import parallel
from libero_env.paths import cache_dir
from tests.harness import home

# machine code is named by its source, and takes long to make: it alone is shared, and kept
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_dir() / "compiled"))
os.environ.setdefault("WARP_CACHE_PATH", str(cache_dir() / "compiled_by_warp"))
home.move_in()
REGISTRIES = (  # which users add to, besides those that are sent to workers
    "libero.libero.benchmark:BENCHMARK_MAPPING", "libero.libero.utils.mu_utils:MU_DICT",
    "libero.libero.utils.mu_utils:SCENE_DICT", "libero.libero.utils.object_utils:EXCEPTION_DICT",
    "libero.libero.utils.task_generation_utils:TASK_INFO", "libero.lifelong.algos:REGISTERED_ALGOS",
    "libero.lifelong.models.base_policy:REGISTERED_POLICIES"
)  # fmt: skip
os.fsync = lambda handle: None  # what a test writes does not outlive the machine
LIBC = ctypes.CDLL(None)
if hasattr(LIBC, "mallopt"):
    LIBC.mallopt(-8, 2)  # M_ARENA_MAX: each of many threads would keep what it frees in one of its own
KEPT: set[str] = set()  # modules that are not of a temporary folder


@pytest.fixture(autouse=True)
def forgetting(tmp_path_factory):
    """Take back what a test registers, and the modules that it imports from a temporary folder."""
    known, path = (*parallel._tables, *REGISTRIES), list(sys.path)
    before = {one: copied(registry(one)) for one in known if one.partition(":")[0] in sys.modules}
    yield
    for address, entries in {**parallel._tables, **before}.items():
        table = registry(address)
        table.clear()
        table.update(copied(entries))
    sys.path[:] = path
    folder = f"{tmp_path_factory.getbasetemp()}{os.sep}"
    for name in sys.modules.keys() - KEPT:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(folder):
            del sys.modules[name]
    KEPT.update(sys.modules)


@pytest.fixture(autouse=True, scope="module")
def giving_back() -> Iterator[None]:
    """Give free memory back after each module: runs ask glibc to keep it for their process, here that of all tests."""
    yield
    if hasattr(LIBC, "malloc_trim"):
        mmap_max, trim_threshold, top_pad = -4, -1, -2  # of mallopt(3)
        for setting, value in ((mmap_max, 65536), (trim_threshold, 2**26), (top_pad, 2**17)):
            LIBC.mallopt(setting, value)
        gc.collect()
        LIBC.malloc_trim(0)


def registry(address: str) -> dict:
    """Return a table by its address; of one that registers in others too, the table alone."""
    module, _, name = address.partition(":")
    table = getattr(importlib.import_module(module), name)
    return table.data if isinstance(table, UserDict) else table


def copied(table: dict) -> dict:
    return {key: value.copy() if isinstance(value, dict | list) else value for key, value in table.items()}


@pytest.fixture(scope="module")
def uncounted() -> Iterator[None]:
    """Count no operations, which makes the steps several times as slow that are counted."""
    from lifelong.training import costs
    from tests.harness.sequences import Uncounted

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(costs, "count_flops", lambda: Uncounted(Uncounted()))
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with the original's task files, measurements and recordings; absent on most machines."""
    path = Path(os.environ.get("LIBERO_SHARED", Path(__file__).parents[2] / "shared"))
    if not (path / "official").is_dir():
        pytest.skip(f"the original's data are not at {path} (set LIBERO_SHARED)")
    return path


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which all processes of the tests record the demonstrations that they share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "demos"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def closing():
    """Return a function that returns its argument, which is closed at the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda opened: stack.enter_context(contextlib.closing(opened))


@pytest.fixture(scope="session")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    """A tab of a browser, in which pages are looked at."""
    from tests.harness.browser import browser  # with a package that not every environment has

    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect without looking for garbage, and look later only among what tests make, and less often."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()
        gc.set_threshold(10_000)


PEAKS: dict[str, int] = {}  # process of tests -> KiB
GROWTH = 200_000_000  # bytes after which what tests have freed is given back
held = 0  # bytes


def pytest_runtest_logfinish() -> None:
    """Give memory back that tests have freed: as much again would be taken from the system by the next ones."""
    global held
    if psutil.Process().memory_info().rss > held + GROWTH:
        gc.collect()
        if hasattr(LIBC, "malloc_trim"):
            LIBC.malloc_trim(0)
        held = psutil.Process().memory_info().rss


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Note the most memory that this process had at once."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["peak"] = peak
    elif not PEAKS:
        PEAKS["pytest"] = peak


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    PEAKS[node.gateway.id] = getattr(node, "workeroutput", {}).get("peak", 0)


def pytest_terminal_summary(terminalreporter) -> None:
    """Say what memory was needed, and in one line why tests were skipped, the most frequent reason first."""
    told = ", ".join(f"{name} {peak / 2**20:.2f} GB" for name, peak in sorted(PEAKS.items()))
    terminalreporter.write_line(f"most memory at once: {told}")
    reasons = Counter(str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", ()))
    if reasons:
        told = "; ".join(
            f"{count}: {reason.removeprefix('Skipped: ')}" for reason, count in reasons.most_common(5)
        )
        terminalreporter.write_line(f"skipped {told}{'; and others' * (len(reasons) > 5)}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as `unit` every test that is not marked as `sim`; begin with those that take long."""
    assert not parallel.user_entries(), (
        "a test module registers as it is imported; every worker would import it"
    )
    for item in items:
        if item.get_closest_marker("sim") is None:
            item.add_marker("unit")
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
