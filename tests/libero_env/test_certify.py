"""Certificates: known outcomes are not run again, each initial state counts once, and the exit status is right."""

import json
from dataclasses import fields, replace
from functools import partial

import mujoco
import pytest

from libero_cli import main as cli
from libero_env.assets.pack import BuiltinPack
from libero_env.design import certify as module
from libero_env.design.certify import Certificate, Outcome, certify, markdown_table, results
from libero_env.errors import LiberoError
from libero_env.objects import ObjectModel, register_object
from libero_env.tasks import Task, find_tasks, get_suite, get_task, make_task, read_task

TASKS = get_suite("libero_object").tasks[:2]


@pytest.fixture
def tried(monkeypatch):
    """Stand-in for the simulator: start 3 always fails. Returns the starts that were tried."""
    seen = []

    def attempt(task, states, pack, disturb):
        seen.extend((task.id, i) for i in states)
        return [Outcome(i, i != 3, 80 + i, i % 2, "" if i != 3 else "it fell") for i in states]

    monkeypatch.setattr(module, "attempt", attempt)
    monkeypatch.setattr(module, "_digest", lambda task, pack, disturb: f"{task.id} {disturb}")
    return seen


def test_only_what_is_missing_is_tried(tried, tmp_path):
    first = certify(TASKS, 20, out=tmp_path, progress=False)
    assert sorted(tried) == [(task.id, i) for task in TASKS for i in range(20)]
    assert certify(TASKS, 20, out=tmp_path, progress=False) == first
    assert len(tried) == 40
    more = certify(TASKS, 25, out=tmp_path, progress=False)
    assert sorted(tried[40:]) == [(task.id, i) for task in TASKS for i in range(20, 25)]
    assert [[o.state for o in c.outcomes] for c in more] == [list(range(25))] * 2
    assert certify(TASKS, 20, out=tmp_path, progress=False) == first
    certify(TASKS, 5, out=tmp_path, again=True, progress=False)
    assert len(tried) == 60


def test_what_was_done_before_a_stop_is_kept(tried, tmp_path, monkeypatch):
    whole, tries = module.attempt, []

    def stopped(*args):
        tries.append(args)
        if len(tries) == 3:
            raise KeyboardInterrupt
        return whole(*args)

    monkeypatch.setattr(module, "attempt", stopped)
    with pytest.raises(KeyboardInterrupt):
        certify(TASKS, 40, out=tmp_path, progress=False)
    found = certify(TASKS, 40, out=tmp_path, progress=False)
    assert len(tried) == len(set(tried)) == 80
    assert [len(c.outcomes) for c in found] == [40, 40]


def test_a_task_with_fewer_stored_states_is_tried_from_those(tried, tmp_path):
    class Short(Task):
        num_starts = 2

    short = Short(**{field.name: getattr(TASKS[0], field.name) for field in fields(Task)})
    (found,) = certify([short], 20, out=tmp_path, progress=False)
    assert [o.state for o in found.outcomes] == [0, 1] and found.rate == 1.0


def test_another_scene_or_expert_is_run_again(tried, tmp_path, monkeypatch):
    certify(TASKS[:1], 4, out=tmp_path, progress=False)
    monkeypatch.setattr(module, "_digest", lambda *args: "another")
    certify(TASKS[:1], 4, out=tmp_path, progress=False)
    assert len(tried) == 8


def test_a_broken_certificate_is_named(tried, tmp_path):
    certify(TASKS[:1], 4, out=tmp_path, progress=False)
    (path,) = tmp_path.rglob("*.json")
    path.write_text('{"outcomes": [1]}')
    with pytest.raises(LiberoError, match=f"{path.name} is not a certificate.*--again"):
        certify(TASKS[:1], 4, out=tmp_path, progress=False)


def test_figures_by_hand(tried):
    (row,) = results(certify(TASKS[:1], 5, progress=False))["tasks"]
    assert (row["successes"], row["states"], row["retries"]) == (4, 5, 2)
    assert row["median_length"] == 81.5 and row["max_length"] == 84  # of 80, 81, 82, 84
    assert row["failures"] == {3: "it fell"}
    nothing = Certificate("a/0", "a", "", (Outcome(0, False, 9, 0, "one | two"),))
    assert nothing.rate == 0.0 and nothing.summary()["median_length"] is None
    table = markdown_table([nothing])
    assert "| a/0 a | 0/1 |  | 0 | 1x one / two |" in table and "0/1 = 0.0 %" in table


def test_the_exit_status_tells_whether_each_task_reaches_the_rate(tried, tmp_path, capsys):
    words = ["tasks", "certify", "libero_object/0", "--jobs", "1", "--out", str(tmp_path)]
    assert cli.main([*words, "--states", "4"]) == 1  # three of four
    assert "FAIL  libero_object/0" in capsys.readouterr().out
    assert cli.main([*words, "--states", "4", "--require", "0.75"]) == 0
    assert cli.main([*words, "--states", "10"]) == 0
    written = json.loads((tmp_path / "results.json").read_text())
    assert written["successes"] == 9 and written["total"] == 10 and len(written["tasks"]) == 1
    assert "9/10" in (tmp_path / "results.md").read_text()


def test_tasks_are_named_once(tmp_path):
    files = [tmp_path / "a.bddl", tmp_path / "b.bddl"]
    for file in files:
        file.write_text(TASKS[0].bddl_text)
    found = find_tasks(["libero_object/3", "libero_object", *map(str, files), str(files[0])])
    assert len(found) == 12 and [task.name for task in found[-2:]] == ["a", "b"]


@pytest.mark.sim
def test_an_outcome_depends_on_its_start_alone():
    pack = BuiltinPack()
    together = module.attempt(TASKS[0], [0, 1, 2], pack, False)
    assert all(o.success and o.steps > 20 for o in together)
    assert module.attempt(TASKS[0], [2], pack, False) == together[2:]


@pytest.mark.sim
def test_a_start_from_which_no_skill_reaches_the_goal_fails_alone():
    places = {"plate_1": (0.05, 0.2), "butter_1": {"at": (0.1, -0.1), "half": 0.05}}
    facts = {"scene": "kitchen", "objects": ["plate", "butter"], "place": places, "language": "put it there"}
    facts["regions"] = {"kitchen_table": {"mat": {"ranges": [[0.05, -0.15, 0.1, -0.05]]}}}
    task = make_task(goal="(And (On butter_1 plate_1) (Never (On butter_1 kitchen_table_mat)))", **facts)
    outcomes = module.attempt(task, range(6), BuiltinPack(), False)
    broken = [o.state for o in outcomes if "is broken, and no skill takes that back" in o.reason]
    assert 0 < len(broken) < 6 and [o.state for o in outcomes if not o.success] == broken


@pytest.mark.sim
def test_a_changed_object_is_tried_in_the_scene_that_has_it():
    def block(width: float):
        spec = mujoco.MjSpec()
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [width, width, 0.02], "mass": 0.05, "group": 0}
        spec.worldbody.add_body(name="main").add_geom(name="g0", **box)
        ends = {"bottom_offset": (0, 0, -0.02), "top_offset": (0, 0, 0.02)}
        return ObjectModel("block", spec, horizontal_radius=width, **ends)

    places = {"block_1": (0, 0), "plate_1": (0.05, 0.2)}
    facts = {"scene": "kitchen", "objects": ["block", "plate"], "place": places, "language": "lift it"}
    solved = []
    for width in (0.02, 0.06):  # a hand opens 0.08 m
        register_object("block", partial(block, width))
        task = make_task(goal="On block_1 plate_1", **facts)
        solved.append(module.attempt(task, [0], BuiltinPack(), False)[0].success)
    assert solved == [True, False]


@pytest.mark.sim
def test_what_cannot_be_tried_fails_with_the_reason():
    unknown = replace(TASKS[0].problem, objects={**TASKS[0].problem.objects, "sword_1": "sword"})
    (certificate,) = certify([replace(TASKS[0], problem=unknown)], 2, progress=False)
    assert [o.success for o in certificate.outcomes] == [False, False]
    assert all("unknown object category 'sword'" in o.reason for o in certificate.outcomes)


@pytest.mark.sim
@pytest.mark.slow
def test_a_task_file_is_certified_in_two_processes(tmp_path, monkeypatch):
    monkeypatch.setattr("libero_env.design.certify.BATCH", 2)
    file = tmp_path / "mine.bddl"
    file.write_text(get_task("libero_object/2").bddl_text)
    (found,) = certify([read_task(file)], 3, jobs=2, progress=False)
    assert [o.state for o in found.outcomes] == [0, 1, 2] and found.rate > 0.6
