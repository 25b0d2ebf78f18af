"""vla-eval's harness, in an environment of its own, on the facade; `vla_eval.evaluate(docker=False)` each time."""

import json

import numpy as np
import pytest

from tests.harness.peers import vla_eval
from tests.harness.recorded import write_actions

pytestmark = [pytest.mark.sim, pytest.mark.slow]

THEIRS = "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark"
TASK = "libero_object/0"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Actions that reach the goal from the first start."""
    return write_actions(tmp_path_factory.mktemp("recorded") / "actions.npz", TASK, 0)


def evaluate(recorded, folder, *benchmarks: dict) -> tuple[dict, dict]:
    """What an evaluation of the recorded actions says, and the first observation of each episode."""
    common = {"max_tasks": 1, "episodes_per_task": 2, "max_steps": len(np.load(recorded)["actions"])}
    entries = json.dumps([{**common, **benchmark} for benchmark in benchmarks])
    found = vla_eval().run(
        "vla_eval_run.py", recorded, entries, folder / "seen.npz", cwd=folder, LIBERO_ASSETS="builtin"
    )
    with np.load(folder / "seen.npz") as seen:
        return found, dict(seen)


def test_their_benchmark_runs_on_the_facade(recorded, tmp_path):
    theirs = {"benchmark": THEIRS, "params": {"suite": "libero_object", "seed": 7}}
    found, seen = evaluate(recorded, tmp_path, theirs)
    assert found["errors"] == [0] and found["recordings"] == 1
    assert found["success"][0] and found["steps"][0] == len(np.load(recorded)["actions"])
    assert found["specs"] == ["Spec validation passed (server↔benchmark compatible)"]
    assert found["prompts"] == ["pick up the alphabet soup and place it in the basket"] * 2
    shapes = {name: value.shape for name, value in seen.items() if name.startswith("0/")}
    assert shapes == {
        "0/agentview": (256, 256, 3),
        "0/wrist": (256, 256, 3),
        "0/states": (8,),
        "0/controller_states": (8,),
    }
