"""The examples in the docstrings of environments run, and give what they show."""

import doctest

import pytest

from libero_env.envs import BatchEnv, LiberoEnv, SubprocEnv

pytestmark = pytest.mark.sim


@pytest.mark.parametrize("environment", [LiberoEnv, BatchEnv, SubprocEnv], ids=lambda cls: cls.__name__)
def test_the_example_runs(environment):
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(environment, globs={environment.__name__: environment})
    assert len(example.examples) >= 5
    report: list[str] = []
    result = doctest.DocTestRunner().run(example, out=report.append)
    assert result.failed == 0, "".join(report)
