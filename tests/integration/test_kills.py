"""Repeated kill -9: the same command always resumes, to the same bits as an uninterrupted run."""

import random

import pytest

from tests.harness.kills import assert_same_runs, finish, kill_somewhere, start

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ALGORITHMS = ("er", "packnet")  # what they carry on: a memory, masks; for more see experiments/kills
KILLS = 4  # of each run


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_killed_four_times_each_run_ends_in_the_same_bits(algo, demos, tmp_path):
    whole = finish(start(algo, tmp_path / "whole", demos), tmp_path / "whole")
    draws, killed = random.Random(f"kills of {algo}"), tmp_path / "killed"
    for _ in range(KILLS):
        assert kill_somewhere(start(algo, killed, demos), killed, draws), "it ended before it could be killed"
    again = finish(start(algo, killed, demos), killed)
    assert_same_runs(again, whole)
