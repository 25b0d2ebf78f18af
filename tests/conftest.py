"""Fixtures shared by all tests."""

import contextlib
import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with the original's task files, measurements and recordings; absent on most machines."""
    path = Path(os.environ.get("LIBERO_SHARED", Path(__file__).parents[2] / "shared"))
    if not (path / "official").is_dir():
        pytest.skip(f"the original's data are not at {path} (set LIBERO_SHARED)")
    return path


@pytest.fixture
def closing():
    """Return a function that returns its argument, which is closed at the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda opened: stack.enter_context(contextlib.closing(opened))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as `unit` every test that is not marked as `sim`."""
    for item in items:
        if item.get_closest_marker("sim") is None:
            item.add_marker("unit")
