"""The linter finds every fault that is put into a correct task, on its line, and none in the benchmark's tasks."""

import json
import math
import re

import mujoco
import numpy as np
import pytest

from libero_cli import main as cli
from libero_env.assets.arena import load_workspace
from libero_env.design.lint import scene as lint_scene
from libero_env.design.lint.checks import Finding, lint_file, lint_task, lint_text, lint_yaml
from libero_env.design.lint.scene import furthest_reach, reach
from libero_env.init_states.store import load_init_states
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_suite, get_task, read_task, suite_names
from libero_env.workspaces import WORKSPACES

SOUND = get_task("libero_goal/3").bddl_text  # open the top layer of the drawer and put the bowl inside
GOAL = "(And (In akita_black_bowl_1 wooden_cabinet_1_top_region))"
TASKS = {task.id: task for name in suite_names() for task in get_suite(name).tasks}


def mutated(old: str, new: str, text: str = SOUND) -> tuple[str, int]:
    """The task with a part replaced, and the line that it is on."""
    assert text.count(old) == 1, old
    return text.replace(old, new), text[: text.index(old)].count("\n") + 1


def found(text: str, rule: str, starts: int = 0) -> Finding:
    hits = [finding for finding in lint_text(text, "mine.bddl", starts=starts) if finding.rule == rule]
    assert len(hits) == 1, lint_text(text, "mine.bddl", starts=starts)
    return hits[0]


# old text, new text, rule, level, and a part of the finding or its remedy
FAULTS = [
    ("plate_1 - plate", "plate_1 - plat", "unknown-category", "error", "did you mean plate"),
    ("main_table - table", "main_table - tabel", "unknown-category", "error", "did you mean .*table"),
    ("    (On plate_1 main_table_plate_region)\n", "", "not-placed", "error", r"\(On plate_1 REGION\)"),
    ("    (On flat_stove_1 main_table_stove_region)\n", "", "not-placed", "warning", "centre of the workspace"),
    ("(-0.060000000000000005 0.12000000000000001 -0.04 0.14)", "(0.04 -0.03 0.060000000000000005 -0.01)",
     "duplicate-region", "warning", "same region as main_table_plate_region"),
    ("    akita_black_bowl_1\n    wooden_cabinet_1_top_region", "    akita_bowl_1", "unknown-name", "warning",
     "did you mean akita_black_bowl_1"),
    ("LIBERO_Tabletop", "LIBERO_Kitchen_Tabletop", "problem-name", "warning", "kitchen_table"),
    ("Open the top layer of the drawer and put the bowl inside", "put the cream cheese in the top drawer",
     "instruction", "warning", "names akita_black_bowl_1"),
    ("Open the top layer of the drawer and put the bowl inside", "put the bowl with the ketchup in the top drawer",
     "instruction", "warning", "names a ketchup, but there is none"),
    ("Open the top layer of the drawer and put the bowl inside", "put the bowl in the bottom drawer",
     "instruction", "warning", "names bottom, but the goal top"),
    (GOAL, "(And (Open wooden_cabinet_1_top_region) (Close wooden_cabinet_1_top_region))", "contradiction", "error",
     "never hold together"),
    (GOAL, "(And (Not (Up plate_1)) (In akita_black_bowl_1 wooden_cabinet_1_top_region) (Up plate_1))",
     "contradiction", "error", r"\(Not \(Up plate_1\)\) and for \(Up plate_1\)"),
    ("main_table - table", "main_table - table\n    other_table - table", "workspace", "error", "2 workspaces"),
    ("(:init", "(:inti", "syntax", "error", "unknown section ':inti'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "rule", "level", "says"), FAULTS, ids=lambda value: str(value)[:30])
def test_a_fault_is_reported(old, new, rule, level, says):
    text, line = mutated(old, new)
    finding = found(text, rule)
    assert finding.level == level and finding.remedy and re.search(says, f"{finding.what} {finding.remedy}")
    if new and rule not in ("not-placed", "placed-twice", "workspace") and finding.what.count("wooden") == 0:
        assert abs(finding.line - line) <= 1  # the first line of what was replaced
    assert str(finding).startswith(f"mine.bddl:{finding.line}: {level}: ")


def test_all_undeclared_names_are_reported_at_once():
    text = SOUND.replace("(On plate_1 main", "(On plat_1 main").replace(GOAL, "(And (In bowl_9 nowhere))")
    findings = [f for f in lint_text(text, "mine.bddl", starts=0) if f.rule == "unknown-name"]
    assert [re.search(r"(\w+) is not", f.what)[1] for f in findings] == ["plat_1", "bowl_9", "nowhere"]
    assert "Did you mean 'plate_1" in str(findings[0])
    assert text.splitlines()[findings[0].line - 1].strip().startswith("(On plat_1")


@pytest.mark.parametrize("text", ["", "(define", "hello", "(define (problem p))", SOUND[:300], "\x00"])
def test_text_that_is_not_a_task_has_one_error_with_a_line(text):
    (finding,) = lint_text(text, "mine.bddl")
    assert finding.level == "error" and finding.rule == "syntax" and finding.line >= 1


def test_a_file_that_is_not_text_is_reported(tmp_path):
    path = tmp_path / "mine.bddl"
    path.write_bytes(b"(define\n\xff)")
    (finding,) = lint_file(path)
    assert (finding.line, finding.rule) == (2, "syntax") and "UTF-8" in finding.remedy


def test_a_file_whose_name_is_not_its_instruction_is_reported(tmp_path):
    path = tmp_path / "my_task.bddl"
    path.write_text(SOUND)
    (finding,) = [f for f in lint_file(path, starts=0) if f.rule == "language"]
    assert finding.level == "info" and "'my task'" in finding.what
    assert finding.what.endswith(f"policies receive {read_task(path).language!r}")


YAML = """\
scene: kitchen
objects: [akita_black_bowl, plate]
place:
  akita_black_bowl_1: [0, 0]
  plate_1: [0.9, 0.2]
goal:
  - On akita_black_bowl_1 plate_1
  - (Not (On plate_1 akita_black_bowl_1))
  - Open plate_1
language: put the mug on the plate
"""


@pytest.mark.parametrize("tasks", [False, True])
def test_lines_of_a_yaml_file_are_those_that_its_user_wrote(tmp_path, tasks):
    """Also where the file has several tasks, or its scene is another file."""
    path, at = tmp_path / "mine.yaml", 0
    path.write_text(YAML)
    if tasks:
        (tmp_path / "scene.yaml").write_text("".join(YAML.splitlines(True)[:5]))
        own = "".join(f"    {line}" for line in YAML.splitlines(True)[5:]).replace("    goal", "  - goal", 1)
        path.write_text(f"scene: scene.yaml\ntasks:\n{own}")
        at = -3
    (findings,) = lint_yaml(path)
    found = {(f.line, f.rule) for f in findings if f.level != "info"}
    assert found >= {(1 if tasks else 5, "off-table"), (9 + at, "no-joint"), (10 + at, "instruction")}
    assert {f.file for f in findings} == {str(path)}


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_texts_of_the_benchmark_have_neither_errors_nor_warnings(task):
    findings = lint_task(task, starts=0)
    assert [str(f) for f in findings if f.level != "info"] == []


@pytest.mark.parametrize("category", WORKSPACES)
def test_the_reach_is_a_ring_before_the_robot(category):
    workspace = load_workspace(category)
    near, far = reach(workspace)
    assert 0.2 < near < 0.32 and 0.74 < far < 0.82 and far < furthest_reach(workspace) < 1.0


@pytest.mark.sim
def test_the_dimensions_of_the_arm_are_those_of_its_model():
    model = build_scene(get_task("libero_object/0").problem).model
    data = mujoco.MjData(model)
    data.qpos[[3, 5]] = -lint_scene._MAX_BEND, 1.0  # any bend of the elbow, by the law of cosines
    mujoco.mj_kinematics(model, data)
    shoulder, wrist, hand = data.xanchor[1], data.xanchor[5], data.xanchor[6]
    assert shoulder[2] == pytest.approx(lint_scene._SHOULDER, abs=1e-3)
    for angle in (-3.0718, -2.0, -1.0):
        data.qpos[3] = angle
        mujoco.mj_kinematics(model, data)
        upper, forearm = lint_scene._UPPER, lint_scene._FOREARM
        at_elbow = 2 * math.pi - (math.pi - math.atan2(0.0825, 0.316) - math.atan2(0.0825, 0.384) - angle)
        expected = math.sqrt(upper**2 + forearm**2 - 2 * upper * forearm * math.cos(at_elbow))
        assert np.linalg.norm(wrist - shoulder) == pytest.approx(expected, abs=1e-3)
        if angle == -3.0718:
            assert at_elbow == pytest.approx(lint_scene._MAX_BEND)
    axis = data.xaxis[6]
    offset = hand - wrist
    assert np.linalg.norm(offset - axis * (axis @ offset)) == pytest.approx(lint_scene._WRIST_OUT, abs=1e-3)
    grip = data.site_xpos[model.site("gripper0_grip_site").id]
    assert abs(axis @ (grip - wrist)) == pytest.approx(lint_scene._HAND, abs=0.01)


PLACES = [
    ("(0.04 -0.03 0.060000000000000005 -0.01)", "(0.7 -0.03 0.72 -0.01)", "off-table", "error", "not all on the table"),
    ("(-0.09999999999999999 -0.01 -0.08 0.01)", "(0.44 -0.01 0.46 0.01)", "out-of-reach", "error", "m from the robot"),
    ("(-0.09999999999999999 -0.01 -0.08 0.01)", "(0.0 0.48 0.2 0.58)", "out-of-reach", "warning", "m from the robot"),
    ("(0.04 -0.03 0.060000000000000005 -0.01)", "(0.4 0.5 0.42 0.52)", "out-of-reach", "info", "m from the robot"),
    ("(top_region (:target wooden_cabinet_1))", "(top_region (:target wooden_cabinet_1))\n (lid (:target plate_1))",
     "unused-region", "info", "plate_1_lid"),
    ("(0.04 -0.03 0.060000000000000005 -0.01)", "(-0.1 -0.01 -0.08 0.01)", "placement", "error", "still collide"),
    ("(On plate_1 main_table_plate_region)", "(On plate_1 wine_bottle_1)", "unstable-start", "warning", "than 5 mm"),
    (GOAL, "(And (Open plate_1))", "no-joint", "error", "no joint"),
    (GOAL, "(And (On plate_1 main_table_plate_region))", "goal-at-start", "error", "5 of 5|3 of 3"),
    (GOAL, "(And (On plate_1 main_table_plate_region) (Open wooden_cabinet_1_top_region))", "goal-at-start", "info",
     "plate_region\\) holds from the beginning"),
]  # fmt: skip


@pytest.mark.sim
@pytest.mark.parametrize(("old", "new", "rule", "level", "says"), PLACES, ids=lambda value: str(value)[:30])
def test_a_fault_of_the_scene_is_reported(old, new, rule, level, says):
    text, _ = mutated(old, new)
    hits = [f for f in lint_text(text, "mine.bddl", starts=3) if f.rule == rule and re.search(says, str(f))]
    assert level in [f.level for f in hits], [str(f) for f in lint_text(text, "mine.bddl", starts=3)]


@pytest.mark.sim
def test_more_starts_than_are_stored_are_all_that_are(monkeypatch):
    one, load = get_task("libero_goal/3"), load_init_states
    monkeypatch.setattr("libero_env.design.lint.scene.load_init_states", lambda *task: load(*task)[:1])
    assert lint_task(one, starts=2) == lint_task(one, starts=1)


@pytest.mark.sim
@pytest.mark.slow
def test_no_task_of_the_benchmark_has_an_error():
    findings = [f for task in TASKS.values() for f in lint_task(task, starts=1)]
    assert [str(f) for f in findings if f.level == "error"] == []
    assert {f.rule for f in findings if f.level == "warning"} <= {"out-of-reach"}


def test_the_command_prints_findings_and_its_status_counts_errors(tmp_path, capsys):
    good, bad = tmp_path / "good.bddl", tmp_path / "bad.bddl"
    good.write_text(SOUND)
    bad.write_text(SOUND.replace("plate_1 - plate", "plate_1 - plat"))
    assert cli.main(["tasks", "lint", str(good), "libero_object/0", "--starts", "0"]) == 0
    assert "2 tasks: 0 errors, 0 warnings, " in capsys.readouterr().out
    assert cli.main(["tasks", "lint", str(good), str(bad), "--starts", "0", "--level", "error"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[0].startswith(f"{bad}:") and "[unknown-category]" in lines[0]
    cli.main(["tasks", "lint", str(good), str(bad), "--starts", "0", "--level", "error", "--json"])
    assert [one["level"] for one in json.loads(capsys.readouterr().out)] == ["error"]
    cli.main(["tasks", "lint", "libero_object/0", "libero_object-0", "--starts", "0"])
    assert capsys.readouterr().out.startswith("1 task: "), "each once, whatever it is called"
    assert cli.main(["tasks", "lint", "libero_objet/1"]) == 2
    assert cli.main(["tasks", "lint", str(tmp_path / "none.bddl")]) == 2


@pytest.mark.sim
def test_zones_and_starts_are_judged_as_what_they_are(tmp_path, capsys):
    """A zone is used, and an init atom of a region with `goal` in its name is not the goal."""
    (tmp_path / "a.yaml").write_text("""language: put the bowl on the plate
scene: kitchen
objects: [akita_black_bowl, plate, wine_bottle]
regions: {kitchen_table: {goal_spot: {at: [0, 0], half: 0.02}, mat: {at: [0.1, -0.2], half: 0.05}}}
place: {plate_1: [0.05, 0.2], akita_black_bowl_1: kitchen_table_goal_spot, wine_bottle_1: [-0.1, -0.2]}
zones: [kitchen_table_mat]
goal: On akita_black_bowl_1 plate_1
""")
    cli.main(["tasks", "lint", str(tmp_path / "a.yaml"), "--starts", "1", "--json", "--level", "info"])
    rules = {one["rule"] for one in json.loads(capsys.readouterr().out)}
    assert not rules & {"unused-region", "goal-at-start"}
