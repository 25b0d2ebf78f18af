"""vla-eval's harness, in an environment of its own, on the facade; without Docker."""

import json
from contextlib import closing

import numpy as np
import pytest

from libero_env.tasks import get_task
from libero_eval.protocols.adapter import ProtocolAdapter
from libero_eval.protocols.environment import ProtocolEnv, resolve_world
from libero_eval.protocols.files import load_protocol
from tests.harness.peers import vla_eval
from tests.harness.recorded import write_actions

pytestmark = [pytest.mark.sim, pytest.mark.slow]

THEIRS = "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark"
SUITE = "libero_90"  # its first task takes the fewest steps


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Actions that reach the goal from the first start."""
    return write_actions(tmp_path_factory.mktemp("recorded") / "actions.npz", f"{SUITE}/0", 0)


def evaluate(recorded, folder, *benchmarks: dict) -> tuple[dict, dict]:
    """What an evaluation of the recorded actions says, and the first observation of each episode."""
    common = {"max_tasks": 1, "episodes_per_task": 2, "max_steps": len(np.load(recorded)["actions"])}
    entries = json.dumps([{**common, **benchmark} for benchmark in benchmarks])
    found = vla_eval().run(
        "vla_eval_run.py",
        recorded,
        entries,
        folder / "seen.npz",
        cwd=folder,
        LIBERO_ASSETS="builtin",
        LIBERO_DRAWING="faithful",  # as ours draws, whatever the models
    )
    with np.load(folder / "seen.npz") as seen:
        return found, dict(seen)


def test_their_benchmark_runs_on_the_facade(recorded, tmp_path):
    """vla-eval's own benchmark and server, on our simulations: recorded actions reach the goal as here."""
    theirs = {"benchmark": THEIRS, "params": {"suite": SUITE, "seed": 7}}
    found, seen = evaluate(recorded, tmp_path, theirs)
    assert found["errors"] == [0]
    assert found["specs"] == ["Spec validation passed (server↔benchmark compatible)"]
    assert found["prompts"] == ["close the top drawer of the cabinet"] * 2
    assert found["success"][0] and found["steps"][0] == len(np.load(recorded)["actions"])
    task = get_task(f"{SUITE}/0")
    protocol, _ = resolve_world(load_protocol("vla-eval"), [task], "builtin")
    with closing(ProtocolEnv(protocol, task, 1, assets="builtin")) as env:
        adapter = ProtocolAdapter(protocol, env.task)
        for episode in range(2):
            obs, _ = env.reset(options={"init_state": np.array([episode])})
            for _ in range(protocol.settle_steps):
                obs, *_ = env.step(np.asarray(protocol.episode.settle_action)[None])
            (given,) = adapter.inputs(obs)
            for name, image in (("agentview", "agentview"), ("wrist", "robot0_eye_in_hand")):
                np.testing.assert_array_equal(seen[f"{episode}/{name}"], given.images[image])
            np.testing.assert_array_equal(seen[f"{episode}/states"], given.state)
