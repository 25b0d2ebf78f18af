"""vla-eval's harness, in an environment of its own, on the facade and on our benchmark; without Docker each time."""

import json

import numpy as np
import pytest

from libero_env.cli import main as cli
from tests.harness.peers import vla_eval
from tests.harness.recorded import write_actions
from tests.harness.runs import make_run

pytestmark = [pytest.mark.sim, pytest.mark.slow]

THEIRS = "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark"
OURS = "vla_eval_libero_lifelong.benchmark:LiberoBenchmark"
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
        "vla_eval_run.py", recorded, entries, folder / "seen.npz", cwd=folder, LIBERO_ASSETS="builtin"
    )
    with np.load(folder / "seen.npz") as seen:
        return found, dict(seen)


def test_both_benchmarks_give_the_same_episodes(recorded, tmp_path):
    """vla-eval's own on the facade, and ours: the same actions have the same outcome."""
    theirs = {"benchmark": THEIRS, "params": {"suite": SUITE, "seed": 7}}
    ours = {"benchmark": OURS, "params": {"suite": SUITE, "seed": 7}}
    found, seen = evaluate(recorded, tmp_path, theirs, ours)
    assert found["errors"] == [0, 0] and found["recordings"] == 1
    assert found["specs"] == ["Spec validation passed (server↔benchmark compatible)"] * 2
    assert found["prompts"] == ["close the top drawer of the cabinet"] * 4
    assert found["success"][0] and found["steps"][0] == len(np.load(recorded)["actions"])
    assert found["success"][:2] == found["success"][2:] and found["steps"][:2] == found["steps"][2:]
    shapes = {"agentview": (256, 256, 3), "wrist": (256, 256, 3), "states": (8,), "controller_states": (8,)}
    for episode in range(2):
        for name, shape in shapes.items():
            a, b = seen[f"{episode}/{name}"], seen[f"{episode + 2}/{name}"]
            assert a.shape == b.shape == shape and a.dtype == b.dtype
            if name == "controller_states":  # which the original's controller measured some substeps before
                np.testing.assert_allclose(a, b, atol=1e-2)
            else:
                np.testing.assert_array_equal(a, b)
    told = found["started"][2]
    assert told["protocol"] == "vla-eval" and told["models"] == "builtin" and told["drawing"] == "faithful"
    assert {"models_digest", "mujoco", "protocol_digest"} <= set(told)


def test_a_run_acts_as_in_process(tmp_path):
    """The third way of a checkpoint, after `libero eval RUN` and `libero eval ws://...`: actions to the bit."""
    data = ("data.robot=robosuite-1.4.1", "data.drawing=faithful")
    make_run(tmp_path / "run", "algo=packnet", "policy/head=gmm_small", "policy.stochastic=true", *data)
    out = tmp_path / "local"
    options = ["--episodes", "2", "--unit-starts", "1", "--horizon", "8", "--threads", "1"]
    card = tmp_path / "libero.yaml"
    card.write_text("extends: libero\nworld: {perturb: 'instruction=0.8'}\n")
    options += ["--protocol", str(card)]
    assert cli.main(["eval", str(tmp_path / "run"), "--out", str(out), *options]) == 0
    tasks = json.loads((out / "eval.json").read_text())["tasks"][:1]
    entry = {
        "benchmark": OURS,
        "params": {
            "suite": "libero_object",
            "card": str(card),
            "task_ids": [int(tasks[0]["task"].partition("/")[2])],
        },
        "episodes_per_task": 2,
        "max_steps": 8,
    }
    found = vla_eval().run("vla_eval_served_run.py", tmp_path / "run", json.dumps([entry]), cwd=tmp_path)
    assert found["errors"] == [0]
    assert found["steps"] == tasks[0]["lengths"] and found["success"] == tasks[0]["successes"]
    assert found["actions"] == tasks[0]["actions"]
    # after the five settling steps
    card.write_text("extends: libero\nworld: {perturb: 'goal=1@step7'}\n")
    found = vla_eval().run("vla_eval_served_run.py", tmp_path / "run", json.dumps([entry]), cwd=tmp_path)
    assert found["errors"] == [2], "the benchmark tells the other goal, and a run cannot be told it"


@pytest.mark.parametrize(("params", "message"), [
    ({"card": "openpi", "env_seed": 0}, "world.env_seed: protocol openpi has 7, the policy 0"),
    ({"card": "openpi", "env_seed": 0, "observations": ["agentview_rgb"]}, "world.env_seed: protocol openpi has 7"),
    ({"card": "starvla"}, "proprioception.source: protocol starvla has 'none', the policy 'observation'"),
    ({"card": "simplevla-rl", "send_state": False}, "the policy needs robot0_eye_in_hand"),
    ({"camera_size": [64, 64]}, "camera_size: protocol vla-eval has its own"),
    ({"observations": ["agentview_rgb"], "absolute_action": True}, "absolute_action cannot be used with observations"),
    ({"observations": ["agentview_rgb"], "card": "goals.yaml"}, "absolute_action cannot be used with observations"),
])  # fmt: skip
def test_a_server_for_another_protocol_is_refused(recorded, tmp_path, params, message):
    (tmp_path / "goals.yaml").write_text("{extends: libero, world: {delta: false}}")
    entry = {"benchmark": OURS, "params": {"suite": "libero_object", **params}}
    with pytest.raises(AssertionError) as refused:
        evaluate(recorded, tmp_path, entry)
    assert message in str(refused.value)
