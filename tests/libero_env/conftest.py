"""Fixtures of the tests of the benchmark."""

import json

import pytest

from libero_env.limited import limited_process
from libero_env.objects import catalog


@pytest.fixture(scope="session")
def measured_objects(shared) -> dict:
    """Measurements of the original's objects, category -> record."""
    return json.loads((shared / "official" / "objects.json").read_text())


@pytest.fixture(scope="session")
def measured_workspaces(shared) -> dict:
    """Measurements of the original's workspaces, problem -> record."""
    return json.loads((shared / "official" / "workspaces.json").read_text())


@pytest.fixture(scope="module")
def one_process():
    """All files of a module are read in the same process with limits."""
    with limited_process():
        yield


@pytest.fixture
def objects_home(tmp_path, monkeypatch, one_process):
    """A folder with an empty one for objects and one for caches; registrations end with the test."""
    monkeypatch.setenv("LIBERO_OBJECTS", str(tmp_path / "objects"))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(catalog, "_registered", {})
    return tmp_path
