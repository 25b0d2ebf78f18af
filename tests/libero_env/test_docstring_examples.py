"""The examples in docstrings run, and give what they show."""

import doctest

import pytest

from libero_env.envs import BatchEnv, LiberoEnv, SubprocEnv
from libero_env.expert import Expert

pytestmark = pytest.mark.sim


@pytest.mark.parametrize("cls", [LiberoEnv, BatchEnv, SubprocEnv, Expert], ids=lambda cls: cls.__name__)
def test_the_example_runs(cls):
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(cls, globs={cls.__name__: cls})
    assert len(example.examples) >= 5
    report: list[str] = []
    result = doctest.DocTestRunner().run(example, out=report.append)
    assert result.failed == 0, "".join(report)
