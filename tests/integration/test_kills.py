"""Repeated kill -9: the same command always resumes, to the same bits as an uninterrupted run."""

import random
from pathlib import Path

import pytest

from tests.harness.kills import assert_same_runs, finish, kill_somewhere, start

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ALGORITHMS = ("er", "ewc", "packnet", "derpp")  # what they carry on: a memory, tensors, masks, outputs
KILLS = 5  # of each run


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("demos")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_killed_five_times_each_run_ends_in_the_same_bits(algo, demos, tmp_path):
    whole = finish(start(algo, tmp_path / "whole", demos), tmp_path / "whole")
    draws, killed = random.Random(f"kills of {algo}"), tmp_path / "killed"
    for _ in range(KILLS):
        assert kill_somewhere(start(algo, killed, demos), killed, draws), "it ended before it could be killed"
    again = finish(start(algo, killed, demos), killed)
    assert_same_runs(again, whole)


def test_there_are_at_least_twenty_kills():
    assert KILLS * len(ALGORITHMS) >= 20
