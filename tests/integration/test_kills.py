"""Repeated kill -9: the same command always resumes, to the same bits as an uninterrupted run."""

import random

import pytest

from tests.harness.kills import assert_same_runs, finish, kill_somewhere, start

pytestmark = [pytest.mark.sim, pytest.mark.slow]

KILLS = 2


def test_killed_twice_a_run_ends_in_the_same_bits(demos, tmp_path):
    algo = (
        "er"  # carries a memory on; for others see experiments/kills, and the writes of each in test_sequence
    )
    whole = finish(start(algo, tmp_path / "whole", demos), tmp_path / "whole")
    draws, killed = random.Random(f"kills of {algo}"), tmp_path / "killed"
    own = killed, tmp_path / "demos", "eval.beside=true"  # it records demonstrations meanwhile, too
    for _ in range(KILLS):
        assert kill_somewhere(start(algo, *own), killed, draws), "it ended before it could be killed"
    again = finish(start(algo, *own), killed)
    assert_same_runs(again, whole)
