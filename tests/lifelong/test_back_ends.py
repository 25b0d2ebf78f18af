"""Results name the back end that simulated them, and those of different ones are never mixed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from libero_cli.main import main
from libero_env.envs.batch import BatchEnv
from libero_eval.judging.comparability import Group, check_comparable, check_same_back_end
from libero_eval.judging.comparison import compare_groups
from libero_eval.protocols.files import load_protocol
from lifelong.errors import ComparisonError, ProtocolError
from lifelong.evaluation.rollout import run_episodes
from lifelong.report.comparison import compare
from tests.harness.results import PROTOCOL, drawn_result


def result(seed, backend=None):
    found = drawn_result(0.8, seed, suites=("libero_goal",), policy=f"p{seed}:make")
    world = {} if backend is None else {"backend": backend}
    return replace(found, protocol={**PROTOCOL, "world": {**PROTOCOL.get("world", {}), **world}})


def test_a_protocol_names_it():
    protocol = load_protocol("libero")
    assert protocol.world.backend == "mujoco"
    changed = protocol.changed({"world.backend": "warp"})
    assert changed.digest != protocol.digest and changed.resolved()["world"]["backend"] == "warp"
    with pytest.raises(ProtocolError, match="world.backend"):
        protocol.changed({"world.backend": "bullet"})


def test_results_of_different_ones_are_not_compared():
    sides = [Group("old", (result(1),)), Group("new", (result(2, "warp"),))]
    with pytest.raises(ComparisonError) as caught:
        check_comparable(sides, allow=["protocol", "environment"])
    assert str(caught.value) == (
        "results of different back ends are not compared: old on backend=mujoco, new on backend=warp; evaluate all on "
        "one, see --backend"
    )
    assert [one.results[0].backend for one in sides] == ["mujoco", "warp"]


@pytest.mark.parametrize("backend", [None, "warp"])
def test_a_comparison_names_it(backend):
    found = compare_groups([Group("a", (result(1, backend),)), Group("b", (result(2, backend),))])
    assert found.to_plain()["backend"] == (backend or "mujoco")
    assert any("backend=warp" in note for note in found.notes) == (backend == "warp")


def test_runs_of_different_ones_are_not_compared():
    def run(backend):
        return SimpleNamespace(path=f"runs/{backend}", metrics={}, record=SimpleNamespace(backend=backend))

    groups = [SimpleNamespace(label=name, runs=[run(name)]) for name in ("mujoco", "warp")]
    with pytest.raises(
        ComparisonError, match=r"mujoco \(runs/mujoco\) on backend=mujoco, warp \(runs/warp\)"
    ):
        compare(groups)
    check_same_back_end({"a": "warp", "b": "warp"})


def test_the_command_names_what_is_not_valid(capsys, tmp_path):
    assert (
        main(["eval", "expert", "--suite", "libero_goal/3", "--backend", "wrap", "--out", str(tmp_path)]) == 2
    )
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "mujoco" in error and "warp" in error


@pytest.mark.sim
@pytest.mark.parametrize("backend", ["mujoco", pytest.param("warp,device=cpu", marks=pytest.mark.slow)])
def test_a_simulation_that_diverges_ends_its_own_episode_on_each(backend):
    if backend != "mujoco":
        pytest.importorskip("mujoco_warp")

    class Breaking:
        action_dim, views, calls = 7, (), 0

        def reset(self, num_envs): ...

        def act(self, obs):
            self.calls += 1
            if self.calls == 3:
                on_device = getattr(env.simulations, "device_data", None)
                qvel = env.simulations.fields["qvel"] if on_device is None else on_device.qvel.numpy()
                qvel[1, 12] = np.nan
            return np.zeros((3, 7))

    with BatchEnv("libero_object/3", 3, num_threads=1, cameras=(), backend=backend) as env:
        done = run_episodes(Breaking(), env, [0, 1, 2], horizon=6, settle_steps=1)
    assert [e.length for e in done.episodes] == [6, 3, 6] and "diverged" in done.episodes[1].simulation_error
    assert done.columns()["init_states"] == (0, 2) and list(done.failed) == [1]
