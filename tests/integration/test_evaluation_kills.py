"""Repeated kill -9 of processes that share an evaluation: the result is that of one process, to the bit."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.sim, pytest.mark.slow]

SCRIPT = Path(__file__).parents[2] / "experiments" / "kills" / "evaluations.py"
SMALL = ["--suite", "libero_object/0", "--episodes", "8", "--unit-starts", "2"]
SMALL += ["--horizon", "50", "--pause", "0.1"]  # the last units take longer than the pauses before the kills


CHANGED = ["--event", "object=0.5@step8", "light=1@25%", "--clock", "latency=lognormal:120/0.5ms,wait=repeat"]


def test_killed_twice_three_processes_end_with_the_result_of_one():
    done = subprocess.run(
        [sys.executable, SCRIPT, "--kills", "2", *SMALL, *CHANGED],
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "kills: 2" in done.stdout and "units: 4, episodes: 8" in done.stdout
    assert "different: nothing but times; left behind: nothing" in done.stdout
