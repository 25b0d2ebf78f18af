"""The examples in docstrings run as they are."""

import doctest
import importlib
from pathlib import Path

import mujoco
import pytest

import libero_env
from libero_env.objects import catalog

pytestmark = pytest.mark.sim
ROOT = Path(libero_env.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts)
    for path in ROOT.rglob("*.py")
    if "    >>> " in path.read_text(encoding="utf-8")
)


assert {"libero_env.objects.catalog", "libero_env.tasks.builder"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name, monkeypatch):
    monkeypatch.setattr(catalog, "_registered", dict(catalog._registered))
    module = importlib.import_module(name)
    found = doctest.DocTestFinder().find(module, globs={**vars(module), "mujoco": mujoco})
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    results = [runner.run(test) for test in found if test.examples]
    assert results and sum(result.failed for result in results) == 0
