"""Certificates of perturbations: what the expert does not solve is drawn again, counted, and kept."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from libero_cli.main import main
from libero_env import LiberoEnv, LiberoError, get_suite, get_task
from libero_env.design import certify_perturbed
from libero_env.design.certify_perturbed import REDRAWS, attempt_perturbed, shares_table
from libero_env.design.preview import compare_starts
from libero_env.objects import builtin, catalog, register_object
from libero_env.perturbations import Perturbation, kinds
from libero_env.sim.scene import build_scene

pytestmark = pytest.mark.sim
TASK = get_task("libero_goal/3")
ROBOT = Perturbation("robot", 0.4)


@pytest.fixture
def expert(monkeypatch):
    """An expert that solves what `solves` says, of the starts that it is given."""
    seen = SimpleNamespace(solves=lambda row: True, joints=[])

    def run(env, experts):
        rows = env.simulations.fields["qpos"][: len(experts), :7]
        seen.joints.append(rows.copy())
        return [SimpleNamespace(success=bool(seen.solves(row)), reason="too far") for row in rows]

    monkeypatch.setattr(certify_perturbed, "run_experts", run)
    monkeypatch.setattr(certify_perturbed, "Shapes", lambda scene: None)
    return seen


def test_what_the_expert_does_not_solve_is_drawn_again_for_that_start(expert, closing):
    first = attempt_perturbed(TASK, ROBOT, range(3))
    assert first.solved == {"0": 0, "1": 0, "2": 0} and first.at_first == 3 and first.redraws == 0
    failing = expert.joints[0][1]
    expert.solves = lambda row: not np.array_equal(row, failing)
    found = attempt_perturbed(TASK, ROBOT, range(3))
    assert found.solved == {"0": 0, "1": 1, "2": 0} and found.redraws == 1 and found.at_first == 2
    name = ROBOT.sample_name(TASK.id, 1)
    assert {key: n for key, n in found.attempts(ROBOT).items() if n} == {name: 1}
    env = closing(LiberoEnv(TASK, cameras=(), perturb=[ROBOT]))
    for attempts, attempt, joints in ((found.attempts(ROBOT), 1, expert.joints[-1][0]), ({}, 0, failing)):
        with kinds.trying(attempts):
            observation, info = env.reset(options={"init_state": 1})
        assert info["attempts"].tolist() == [attempt]
        np.testing.assert_array_equal(observation["joint_states"], joints)
    assert not np.array_equal(expert.joints[-1][0], failing)


def test_a_task_that_is_mostly_not_solved_is_drawn_again_as_a_whole(expert):
    expert.solves = lambda row: len(expert.joints) > 2
    found = attempt_perturbed(TASK, Perturbation("layout", 0.4), range(2))
    assert found.drawn_again == 2 and found.solved == {"0": 0, "1": 0}
    assert list(found.attempts(Perturbation("layout", 0.4)).values()) == [0, 0, 2]
    expert.solves = lambda row: False
    found = attempt_perturbed(TASK, ROBOT, range(2))
    assert found.failures == {"0": "too far", "1": "too far"} and found.at_first == 0 and found.redraws == 0
    assert len(expert.joints) == 3 + 1 + REDRAWS


def test_results_are_on_disk_and_are_not_run_again(expert, tmp_path, capsys, monkeypatch):
    other, file = {"libero_goal/4 robot=0.4@0 1": 2}, tmp_path / "draws.json"
    file.write_text(json.dumps({ROBOT.sample_name("libero_goal/3"): 3} | other))
    monkeypatch.setattr(kinds, "attempts_file", lambda: file)
    words = ["perturb", "certify", "libero_goal/3", "--kinds", "robot", "gain", "--severities", "0.4"]
    words += ["--starts", "2", "--jobs", "1", "--out", str(tmp_path)]
    expert.solves = lambda row: len(expert.joints) > 1
    assert main([*words, "--keep"]) == 0
    assert "robot=0.4                   2      0.0%      100.0%        2" in capsys.readouterr().out
    now = {ROBOT.sample_name("libero_goal/3", start): 1 for start in (0, 1)}
    assert json.loads(file.read_text()) == now | other, "the first draw of the whole task is solved now"
    count = len(expert.joints)
    assert main([*words, "--json"]) == 0 and len(expert.joints) == count
    rows = json.loads(capsys.readouterr().out)
    assert [row["perturbation"] for row in rows] == ["robot=0.4", "gain=0.4"]
    assert rows[0]["solved"] == {"0": 1, "1": 1}
    (result,) = tmp_path.glob("*/*/robot*.json")
    result.write_text("{}")
    assert main(words) == 2 and "not a certificate" in capsys.readouterr().err


def test_results_of_other_models_are_not_taken(monkeypatch):
    monkeypatch.setattr(catalog, "_registered", {})
    task, digests = get_task("libero_object/0"), []
    for category in ("milk", "ketchup"):
        register_object("milk", lambda category=category: replace(builtin.build(category), category="milk"))
        digests.append(certify_perturbed._digest(task, ROBOT, 2, REDRAWS))
    monkeypatch.setattr(certify_perturbed, "scene_digest", lambda *_: build_scene(task.problem).digest)
    monkeypatch.setattr(certify_perturbed, "select_pack", lambda: SimpleNamespace(name="another"))
    digests.append(certify_perturbed._digest(task, ROBOT, 2, REDRAWS))
    assert len(set(digests)) == 3


def test_results_of_tasks_of_files_are_kept_apart(tmp_path):
    tasks = [replace(task, suite="file", index=0) for task in get_suite("libero_goal").tasks[:2]]
    assert len({certify_perturbed._path(tmp_path, task, ROBOT) for task in tasks}) == 2


def test_a_severity_counts_once_and_is_above_0(expert, tmp_path, capsys):
    words = ["perturb", "certify", "libero_goal/3", "--kinds", "gain", "--starts", "1", "--jobs", "1"]
    words += ["--out", str(tmp_path), "--severities"]
    assert main([*words, "0.4", "0.4"]) == 0 and capsys.readouterr().out.count("gain=0.4") == 1
    for wrong, said in ((["0.4", "0"], "--severities 0.0"), ([], "severities are missing")):
        with pytest.raises(SystemExit):
            main([*words, *wrong])
        assert said in capsys.readouterr().err


def test_a_task_that_cannot_be_perturbed_is_told(expert):
    found = attempt_perturbed(get_suite("libero_90").tasks[12], Perturbation("objects", 1.0), range(2))
    assert "no object" in found.impossible and found.starts == 0
    assert "1 of 1 tasks" in shares_table([found], [Perturbation("objects", 1.0)])[1]


def test_a_picture_shows_both(tmp_path):
    out, words = tmp_path / "a.png", ["--perturb", "light=1", "--size", "32", "--out"]
    assert main(["perturb", "show", "libero_goal/1", *words, str(out)]) == 0
    picture = np.asarray(Image.open(out))
    assert picture.shape == (64, 64, 3) and not np.array_equal(picture[:, :32], picture[:, 32:])
    assert main(["perturb", "show", "libero_goal", *words, str(tmp_path / "b.png")]) == 2
    assert not (tmp_path / "b.png").exists()
    with pytest.raises(LiberoError, match="ends in"):
        compare_starts(TASK, [], tmp_path / "a.txt")
