"""`libero eval` on variants of LIBERO-Plus: one trial each, told without ids, reported by kind."""

import pytest

from libero_cli.main import main
from libero_env.init_states.store import load_init_states
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_suite
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.protocols.files import load_protocol
from tests.harness.evaluations import write_policy
from tests.harness.published import REWORDED, base_task, write_plus, write_pro

pytestmark = pytest.mark.sim
EVAL = ["eval", "told_policy:make", "--horizon", "2", "--threads", "1"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with files as LIBERO-Plus' and LIBERO-PRO's, and a policy that notes what it is told."""
    scene = build_scene(base_task().problem)
    states = load_init_states(base_task(), scene)[:, : 1 + scene.model.nq + scene.model.nv]
    monkeypatch.setenv("LIBERO_PLUS", str(write_plus(tmp_path / "plus", states)))
    monkeypatch.setenv("LIBERO_PRO", str(write_pro(tmp_path / "pro", states)))
    own = "cameras, camera_size, observations = ('agentview',), (32, 32), ('rgb',)"
    write_policy(tmp_path / "told_policy.py", "np.zeros((len(observations['agentview_rgb']), 7))", own)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_variants_have_one_trial_each_and_are_reported_by_kind(folder, capsys):
    assert main([*EVAL, "--suite", "libero_plus_goal:available", "--out", "out"]) == 0
    result = EvaluationResult.read(folder / "out")
    assert [task.task for task in result.tasks] == [f"libero_plus_goal/{i}" for i in (0, 1, 2, 3, 7)]
    assert all(task.init_states == (0,) for task in result.tasks)
    told = (folder / "told.txt").read_text().splitlines()
    assert set(told) == {"put the bowl on the plate", REWORDED.lower()}
    shown = capsys.readouterr().out
    for kind in ("camera", "robot", "noise", "language", "layout"):
        assert f"  {kind} " in shown


def test_what_cannot_be_run_ends_before_anything_runs(folder, capsys):
    assert main([*EVAL, "--suite", "libero_plus_goal", "--out", "out"]) != 0
    assert "3 of 8 tasks need files" in (error := capsys.readouterr().err) and error.count("\n") == 1
    moved = ["--suite", "libero_plus_goal:layout", "libero_plus_goal/7"]
    assert main([*EVAL, "--suite", moved[2], "--episodes", "2", "--out", "out"]) != 0
    assert "has one initial state" in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_tasks_and_variants_are_listed(folder, capsys):
    assert main(["tasks", "list"]) == 0
    assert "libero_plus_goal             8 variants" in capsys.readouterr().out
    assert main(["tasks", "list", "libero_plus_goal:robot"]) == 0
    assert capsys.readouterr().out.startswith(
        "libero_plus_goal/1       robot      put the bowl on the plate  ("
    )
    assert main(["tasks", "init-states", "libero_plus_goal"]) != 0
    assert "nothing to generate" in capsys.readouterr().err


def test_a_protocol_has_the_horizon_of_the_base_task(folder):
    card = load_protocol("openpi")
    for name in ("libero_plus_goal", "libero_pro_goal_task"):
        assert card.steps(get_suite(name).tasks[0]) == card.steps(base_task())
