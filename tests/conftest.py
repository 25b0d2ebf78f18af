"""Fixtures shared by all tests."""

import contextlib
import gc
import importlib
import os
import sys
from collections import UserDict
from collections.abc import Iterator
from pathlib import Path

import pytest

from libero_env import parallel

REGISTRIES = (  # which users add to, besides those that are sent to workers
    "libero.libero.benchmark:BENCHMARK_MAPPING", "libero.libero.utils.mu_utils:MU_DICT",
    "libero.libero.utils.mu_utils:SCENE_DICT", "libero.libero.utils.object_utils:EXCEPTION_DICT",
    "libero.libero.utils.task_generation_utils:TASK_INFO", "libero.lifelong.algos:REGISTERED_ALGOS",
    "libero.lifelong.models.base_policy:REGISTERED_POLICIES"
)  # fmt: skip
os.fsync = lambda handle: None  # what a test writes does not outlive the machine
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


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as `unit` every test that is not marked as `sim`."""
    assert not parallel.user_entries(), (
        "a test module registers as it is imported; every worker would import it"
    )
    for item in items:
        if item.get_closest_marker("sim") is None:
            item.add_marker("unit")
