"""Inspect Robots itself, in an environment of its own: it finds our distribution, and its episodes are ours."""

import hashlib
import json

import numpy as np
import pytest

from libero_env.cli import main as cli
from libero_env.envs.env import LiberoEnv
from tests.harness.peers import inspect_robots
from tests.harness.recorded import OPEN, solve
from tests.harness.runs import make_run

pytestmark = [pytest.mark.sim, pytest.mark.slow]

STATE = {
    "joint_pos": "joint_states",
    "joint_vel": "joint_velocities",
    "eef_pos": "ee_pos",
    "eef_quat": "ee_quat",
    "eef_axis_angle": "ee_ori",
    "gripper_qpos": "gripper_states",
}


def evaluate(policy, folder, settle_steps=5, perturb=None, **task) -> tuple[dict, dict]:
    """What Inspect Robots says of an evaluation, and what its policy saw and answered."""
    embodiment = {"camera_size": 32, "assets": "builtin", "settle_steps": settle_steps, "perturb": perturb}
    arguments = (json.dumps(task), json.dumps(embodiment), policy, folder / "seen.npz")
    found = inspect_robots().run("inspect_robots_run.py", *arguments, cwd=folder, LIBERO_ASSETS="builtin")
    if not (folder / "seen.npz").exists():
        return found, {}
    with np.load(folder / "seen.npz") as seen:
        return found, dict(seen)


def test_its_episodes_are_those_of_our_environment(tmp_path):
    actions = np.concatenate([[OPEN] * 10, solve("libero_90/0", 0)])  # the fewest steps
    file = tmp_path / "actions.npz"
    np.savez(file, actions=actions)
    found, seen = evaluate(
        file, tmp_path, suite="libero_90", task_ids=0, num_starts=2, max_steps=len(actions)
    )
    assert all("libero" in found["registered"][kind] for kind in ("task", "embodiment"))
    assert found["scenes"] == ["libero_90-0-start0", "libero_90-0-start1"]
    assert found["instructions"] == ["close the top drawer of the cabinet"] * 2
    env = LiberoEnv(
        "libero_90/0",
        camera_size=(32, 32),
        assets="builtin",
        observations=("rgb", *STATE.values()),
    )
    at, successes = 0, []
    for start in range(2):
        obs, _ = env.reset(options={"init_state": start})
        for _ in range(5):
            obs, *_ = env.step(np.zeros(7))
        for t, action in enumerate(actions):
            assert seen["t"][at] == t
            for name in ("agentview_rgb", "eye_in_hand_rgb"):
                np.testing.assert_array_equal(seen[name][at], obs[name])
            for theirs, ours in STATE.items():
                np.testing.assert_array_equal(seen[theirs][at], obs[ours])
            at += 1
            obs, _, terminated, *_ = env.step(action)
            if terminated:
                break
        successes.append(terminated)
    env.close()
    assert at == len(seen["t"]) and successes[0]
    assert found["metrics"] == {"success_at_end": np.mean(successes)}


def test_a_run_acts_as_in_process(tmp_path):
    perturb = "instruction=0.8"
    make_run(tmp_path / "run", "algo=packnet", "policy/head=gmm_small", "policy.stochastic=true")
    out = tmp_path / "local"
    options = [
        "--episodes",
        "2",
        "--unit-starts",
        "1",
        "--horizon",
        "8",
        "--threads",
        "1",
        "--perturb",
        perturb,
    ]
    assert cli.main(["eval", str(tmp_path / "run"), "--out", str(out), *options]) == 0
    local = json.loads((out / "eval.json").read_text())["tasks"][0]
    suite, _, index = local["task"].partition("/")
    task = {"suite": suite, "task_ids": int(index), "num_starts": 2, "max_steps": 8}
    refused, _ = evaluate(tmp_path / "run", tmp_path, **task)  # the run's smoke settings do not wait
    assert all("-E settle_steps=0" in error for error in refused["errors"]) and len(refused["errors"]) == 2
    other_goal = "goal=1@step2"  # told by the embodiment
    refused, _ = evaluate(tmp_path / "run", tmp_path, settle_steps=0, perturb=other_goal, **task)
    assert refused["errors"] and all("an event has changed the goal" in error for error in refused["errors"])
    found, seen = evaluate(tmp_path / "run", tmp_path, settle_steps=0, perturb=perturb, **task)
    assert not found["errors"]
    assert "libero_run" in found["registered"]["policy"]
    assert len(seen["t"]) == sum(local["lengths"])
    assert found["metrics"] == {"success_at_end": np.mean(local["successes"])}
    episodes = np.split(seen["action"], np.cumsum(local["lengths"])[:-1])
    digests = [hashlib.sha256(np.asarray(one, "<f8").tobytes()).hexdigest()[:16] for one in episodes]
    assert digests == local["actions"]


def test_mistakes_are_its_own_errors(tmp_path):
    found = inspect_robots().run("inspect_robots_mistakes.py", cwd=tmp_path, LIBERO_ASSETS="builtin")
    assert found == [
        "unknown robot 'panda'. Valid: libero, robosuite-1.4.1",
        "perturb=camera=0.5@25% begins at a share of an episode's length, which Inspect Robots alone knows: name "
        "a step, such as @step40",
        "task_ids [77] do not exist: libero_goal has 0 to 9",
        "num_starts is 51; valid: 1 to 50",
        "nowhere does not exist; give the directory of a run, such as runs/libero_object/er/NAME, or one of its "
        "checkpoints",
    ]
