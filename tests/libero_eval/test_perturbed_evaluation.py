"""An evaluation under perturbations: recorded, told to the policy, paired with the plain one, and run again."""

import numpy as np
import pytest

from libero_cli.main import main
from libero_env.perturbations import KINDS
from libero_env.tasks import get_task, make_task, write_task
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.judging.comparability import Group, check_comparable, match
from libero_eval.protocols.environment import ProtocolEnv
from libero_eval.protocols.files import load_protocol
from lifelong.errors import ComparisonError
from tests.harness.evaluations import write_policy

pytestmark = pytest.mark.sim
EVAL = ["eval", "told_policy:make", "--suite", "libero_goal/1", "--episodes", "3", "--horizon", "3"]
EVAL += ["--threads", "1"]


@pytest.fixture
def told(tmp_path, monkeypatch):
    """A folder with a policy that notes what it is told, and moves as bright as what it sees."""
    monkeypatch.chdir(tmp_path)
    own = "cameras, camera_size, observations = ('agentview',), (32, 32), ('rgb', 'proprioception')"
    moved = "np.outer(observations['agentview_rgb'].mean(axis=(1, 2, 3)) / 255, [1, 0, 0, 0, 0, 0, -1])"
    write_policy(tmp_path / "told_policy.py", moved, own)
    return tmp_path


def test_an_evaluation_records_its_perturbations(told, tmp_path, capsys):
    perturb = ["--perturb", "noise=0.2,instruction=0.5,robot=0.4,distractors=0.1"]
    assert main([*EVAL, "--out", "plain"]) == 0
    assert main([*EVAL, "--out", "changed", *perturb]) == 0
    plain, changed = (EvaluationResult.read(tmp_path / name) for name in ("plain", "changed"))
    assert plain.protocol["world"]["perturb"] == "" and plain.tasks[0].attempts == ()
    assert changed.protocol["world"]["perturb"] == "distractors=0.1,instruction=0.5,robot=0.4,noise=0.2"
    assert np.shape(changed.tasks[0].attempts) == (3, 4)
    words = (tmp_path / "told.txt").read_text().splitlines()
    assert words == ["put the bowl on the stove", changed.tasks[0].instruction] and len(set(words)) == 2
    assert changed.tasks[0].name == plain.tasks[0].name and "_" not in words[1]

    sides = [Group("plain", (plain,)), Group("changed", (changed,))]
    with pytest.raises(ComparisonError, match="protocol.world.perturb"):
        check_comparable(sides)
    check_comparable(sides, allow=["protocol", "tasks"])
    assert len(match(*sides).pairs.starts) == 3

    capsys.readouterr()
    again = ["eval", "changed", "--allow", "told_policy", "--out", "again", "--threads", "1"]
    assert main(again) == 0
    assert EvaluationResult.read(tmp_path / "again").actions == changed.actions
    assert main([*EVAL, "--out", "changed", "--perturb", "camera=0.1"]) == 2, "another is in the folder"
    assert "world.perturb" in capsys.readouterr().err


def test_fixtures_that_a_protocol_draws_are_those_of_the_plain_episode(monkeypatch):
    monkeypatch.setattr(ProtocolEnv, "_stored", lambda self: self.init_states)  # LIBERO's may not be here
    card = load_protocol("openpi").changed({"pixels.render_size": (32, 32)})
    found = []
    for perturb in ("", "layout=0.3,distractors=0.3,robot=0.4"):
        env = ProtocolEnv(
            card.changed({"world.perturb": perturb}), get_task("libero_goal/3"), 2, cameras=(), threads=1
        )
        env.reset(options={"init_state": np.array([3, 7])})
        plate = [view.body_pos("plate_1") for view in env.views]
        found.append((env.simulations.fixtures.copy(), np.array(plate)))
        assert env.task.language == env.base_task.language and len(env.step(np.zeros((2, 7)))) == 5
        env.close()
    assert np.array_equal(found[0][0], found[1][0])
    moved = np.linalg.norm(found[1][1] - found[0][1], axis=1)
    assert moved == pytest.approx(KINDS["layout"].amount(0.3))  # the same for all starts


def test_an_evaluation_with_events_says_where_they_began(told, tmp_path, capsys):
    words = [
        "--perturb",
        "robot=0.4,noise=0.2,action_noise=0.3",
        "--event",
        "camera=0.5@step6",
        "light=1@touched",
    ]
    words += ["--clock", "latency=uniform:0/200ms", "--unit-starts"]
    assert main([*EVAL, "--out", "events", *words, "2"]) == 0
    assert "(events began in 3 of 3 (the expert solves 0 from there), 0 of 3)" in capsys.readouterr().out
    found = EvaluationResult.read(tmp_path / "events")
    perturb = found.protocol["world"]["perturb"]
    assert perturb == "camera=0.5@step6,light=1@touched,robot=0.4,noise=0.2,action_noise=0.3"
    assert found.tasks[0].began == ((6, -1),) * 3
    assert found.tasks[0].solved == ((0, -1),) * 3, "three steps are not enough"
    page = (tmp_path / "events" / "eval.html").read_text()
    assert "events began in 3 of 3 (the expert solves 0 from there), 0 of 3" in page and perturb in page
    assert "failed because never reached 3" in page
    assert main([*EVAL, "--out", "apart", *words, "1", "--workers", "2"]) == 0
    again = EvaluationResult.read(tmp_path / "apart")
    assert again.tasks == found.tasks and again.actions == found.actions
    assert len(found.tasks[0].timing) == 3
    assert main([*EVAL, "--out", "none", "--event", "camera=0.5"]) == 2
    assert main([*EVAL, "--out", "none", "--event", "camera=0.5@lift"]) == 2
    errors = [
        line for line in capsys.readouterr().err.splitlines() if "expected" in line or "trigger" in line
    ]
    assert "expected KIND=SEVERITY@TRIGGER" in errors[0] and "unknown trigger 'lift'" in errors[1]


BUTTER = {
    "scene": "kitchen", "furniture": ["flat_stove"], "objects": ["butter", "plate"],
    "place": {"flat_stove_1": (-0.2, 0.2), "butter_1": (0.0, -0.2), "plate_1": (0.1, -0.25)},
    "regions": {"kitchen_table": {"hot": {"at": (-0.2, 0.1), "half": 0.03}}}, "zones": ["kitchen_table_hot"],
    "language": "turn the stove on and put the butter on the plate",
}  # fmt: skip


@pytest.mark.parametrize(("goal", "perturb"), [
    ("And (Count 1 (Turnon flat_stove_1)) (On butter_1 plate_1) (Never (Incontact robot plate_1))", ""),
    ("And (Turnon flat_stove_1) (On butter_1 plate_1)", "partial=1@1"),
])  # fmt: skip
def test_costs_partial_starts_and_goals_over_time_do_not_depend_on_units_nor_workers(
    goal, perturb, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    path = write_task(make_task(**BUTTER, goal=f"({goal})"), "own.bddl")
    words = ["eval", "expert", "--suite", str(path), "--episodes", "3", "--threads", "1", "--horizon", "60"]
    words += [*(["--perturb", perturb] if perturb else []), "--out"]
    assert main([*words, "together", "--unit-starts", "3"]) == 0
    assert main([*words, "apart", "--unit-starts", "1", "--workers", "2"]) == 0
    together, apart = (EvaluationResult.read(tmp_path / name) for name in ("together", "apart"))
    assert apart.tasks == together.tasks and apart.outcomes == together.outcomes
    assert apart.actions == together.actions
    (found,) = apart.tasks
    assert any(cost.zone for cost in found.costs) and len(set(found.costs)) > 1
    assert len(set(found.atoms_at_start)) == (2 if "@1" in perturb else 1), (
        "which part holds depends on the start"
    )
