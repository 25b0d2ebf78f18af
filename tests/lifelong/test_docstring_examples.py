"""The examples in docstrings run and print what they show."""

import doctest

import pytest

from lifelong.algorithms.base import Algorithm
from lifelong.policies.base import Policy


@pytest.mark.parametrize("documented", [Algorithm, Policy], ids=lambda documented: documented.__name__)
def test_the_example_runs(documented):
    module = __import__(documented.__module__, fromlist=["_"])
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(documented, documented.__name__, globs=vars(module) | {"__name__": "example"})
    assert len(example.examples) > 3
    report: list[str] = []
    result = doctest.DocTestRunner().run(example, out=report.append)
    assert result.failed == 0, "".join(report)
