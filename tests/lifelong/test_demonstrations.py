"""Which file a task's demonstrations are read from."""

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from libero_env.demos.config import GENERATOR, DemoConfig
from libero_env.demos.generate import demo_path
from libero_env.tasks import get_suite
from lifelong.data import demonstrations
from lifelong.data.settings import DataSettings
from lifelong.errors import DataError
from tests.harness.demos import episode, write

TASKS = get_suite("libero_object").tasks[:3]


@pytest.fixture
def recorded(monkeypatch):
    """Return the names of the tasks that would be recorded."""
    names: list[str] = []

    def ensure(tasks, n, *, root, seed, **kwargs):
        names.extend(task.name for task in tasks)
        return [Path(root or "cache") / f"seed{seed}" / f"{task.name}_{n}.hdf5" for task in tasks]

    monkeypatch.setattr(demonstrations, "ensure_demos", ensure)
    return names


def settings(folder):
    return DataSettings(demos=2, image_size=8, seq_len=1, views=["agentview_rgb"], proprio=[], folder=folder)


def write_demos(folder, task, demos):
    path = folder / task.suite / f"{task.name}_demo.hdf5"
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        for i in range(demos):
            file[f"data/demo_{i}/actions"] = np.zeros((4, 7))
            file[f"data/demo_{i}/obs/agentview_rgb"] = np.zeros((4, 8, 8, 3), np.uint8)
    return path


def test_files_in_the_originals_layout_are_used(tmp_path, recorded, monkeypatch, capsys):
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")
    human = write_demos(tmp_path, TASKS[1], 2)
    data = replace(settings(str(tmp_path)), seed=7, robot="robosuite-1.4.1", drawing="faithful")
    found = demonstrations.find_demos(TASKS, [2, 2, 1], data, False)
    assert found[1] == human  # which says nothing of these
    assert recorded == [TASKS[0].name, TASKS[2].name]
    assert [path.name for path in found[::2]] == [f"{TASKS[0].name}_2.hdf5", f"{TASKS[2].name}_1.hdf5"]
    said = f"{human} does not state whose models it shows; policies are evaluated on builtin ones"
    assert said in capsys.readouterr().err
    with h5py.File(human, "a") as file:
        file["data"].attrs["models"] = '{"pack": "builtin"}'
    demonstrations.find_demos(TASKS, [2, 2, 1], data, False)
    assert "whose models" not in capsys.readouterr().err


def own(path, task=TASKS[1], demos=2, size=8, **more):
    """Write demonstrations of a task under any name."""
    stated = {"bddl_file_name": f"x/{task.name}.bddl", "bddl_file_content": task.bddl_text}
    return write(path, [episode(i, size=size) for i in range(demos)], **stated, **more)


def test_named_files_and_files_of_a_folder_are_found_by_the_task_that_they_state(tmp_path, recorded):
    path = own(tmp_path / "deep" / "whatever.hdf5")
    for data in (replace(settings(None), files=[str(path)]), settings(str(tmp_path))):
        assert demonstrations.find_demos(TASKS, [2, 2, 2], data, False)[1] == path
        assert recorded == [TASKS[0].name, TASKS[2].name]
        recorded.clear()
    seeded = replace(settings(str(tmp_path)), seed=5)
    assert demonstrations.find_demos(TASKS[:1], [2], seeded, False)[0].parent.name == "seed5"


def test_a_seed_that_no_file_states_is_refused(tmp_path, recorded):
    """Runs with several would count as several samples."""
    write_demos(tmp_path, TASKS[0], 2)
    data = replace(settings(str(tmp_path)), seed=5)
    with pytest.raises(DataError, match="data.seed=5 has no effect"):
        demonstrations.find_demos(TASKS[:1], [2], data, False)
    demonstrations.find_demos(TASKS[:1], [2], data, False, others=TASKS[1:])
    demonstrations.find_demos(TASKS[:2], [2, 2], data, False)
    assert recorded == [TASKS[1].name]


def test_files_as_they_are_pair_all_actions_in_the_same_way(tmp_path):
    human, expert = write_demos(tmp_path, TASKS[0], 2), own(tmp_path / "own.hdf5")
    stored = replace(settings(None), pairing="stored")
    for files, data in (([human], stored), ([expert], stored), ([human, expert], settings(None))):
        demonstrations.check_pairing(files, data)
    with pytest.raises(
        DataError, match=f"{human} holds the observation after an action, {expert} the one before"
    ):
        demonstrations.check_pairing([expert, human], stored)


def test_a_repeated_task_has_one_file_with_the_most_demonstrations_that_are_required(tmp_path, recorded):
    first, second = demonstrations.find_demos([TASKS[0]] * 2, [3, 1], settings(str(tmp_path)), False)
    assert first == second and first.name == f"{TASKS[0].name}_3.hdf5" and recorded == [TASKS[0].name]
    write_demos(tmp_path, TASKS[1], 2)
    with pytest.raises(DataError, match="has 2 demonstrations and 3 are required"):
        demonstrations.find_demos([TASKS[1]] * 2, [3, 1], settings(str(tmp_path)), False)


@pytest.mark.parametrize(("kwargs", "words"), [
    ({"size": 16}, "16x16 pixels and data.image_size is 8; use data.image_size=16"),
    ({"demos": 1}, "has 1 demonstrations and 2 are required; use data.demos=1"),
    ({"perturb": "light=0.5"}, "was rendered under light=0.5"),
    ({"seed": 2}, "was recorded with seed 2; data.seed is 1"),
    ({"generator": "teleoperation", "robot": "robosuite-1.4.1"}, "data.robot is libero"),
    ({"models": '{"pack": "moon"}'}, "shows the models moon; those of this run are"),
    ({"variation": '{"reserved": true}'}, "stored initial states, from which policies are evaluated"),
])  # fmt: skip
def test_demonstrations_that_do_not_fit_are_refused_by_name(kwargs, words, tmp_path, recorded):
    path = own(tmp_path / "mine.hdf5", **kwargs)
    for data in (
        replace(settings(None), files=[str(path)], seed=1),
        replace(settings(str(tmp_path)), seed=1),
    ):
        with pytest.raises(DataError, match=rf"mine.hdf5 .*{re.escape(words)}"):
            demonstrations.find_demos(TASKS, [2, 2, 2], data, False)
    (tmp_path / "layout" / TASKS[1].suite).mkdir(parents=True)
    file = path.rename(tmp_path / "layout" / TASKS[1].suite / f"{TASKS[1].name}_demo.hdf5")
    with pytest.raises(DataError, match=re.escape(f"data.folder: {file} ") + f".*{re.escape(words)}"):
        in_layout = replace(settings(str(tmp_path / "layout")), seed=1)
        demonstrations.find_demos(TASKS, [2, 2, 2], in_layout, False)
    assert not recorded


def test_what_the_expert_recorded_otherwise_is_told_and_recorded_again(tmp_path, recorded, capsys):
    own(tmp_path / "expert.hdf5", size=16, generator=GENERATOR, robot="libero")
    demonstrations.find_demos(TASKS[1:2], [2], settings(str(tmp_path)), False)
    assert recorded == [TASKS[1].name] and "not used" in capsys.readouterr().err
    demonstrations.find_demos(TASKS[:1], [2], settings(str(tmp_path)), False)
    assert f"other tasks only, such as {TASKS[1].name}" in capsys.readouterr().err


def test_a_file_in_the_layout_is_refused_where_it_states_another_task(tmp_path, recorded):
    (tmp_path / TASKS[1].suite).mkdir()
    own(tmp_path / TASKS[1].suite / f"{TASKS[1].name}_demo.hdf5", TASKS[0])
    with pytest.raises(DataError, match=f"is of '{TASKS[0].name}', not of '{TASKS[1].name}'"):
        demonstrations.find_demos(TASKS, [2, 2, 2], settings(str(tmp_path)), False)


def test_a_file_of_the_user_goes_before_what_the_expert_recorded_in_its_folder(tmp_path, recorded):
    path = demo_path(tmp_path, DemoConfig(TASKS[1], (8, 8)))
    path.parent.mkdir(parents=True)
    expert = {"generator": GENERATOR, "robot": "libero"}
    own(path, **expert)
    own(tmp_path / "seed5.hdf5", **expert | {"seed": 5})
    demonstrations.find_demos(TASKS[1:2], [2], settings(str(tmp_path)), False)
    assert recorded == [TASKS[1].name], "which goes on with its own"
    (tmp_path / "seed5.hdf5").unlink()
    for more in ({"generator": "teleoperation"}, {"filter": "without no-ops"}):
        mine = own(tmp_path / "mine.hdf5", **expert | more)
        assert demonstrations.find_demos(TASKS[1:2], [2], settings(str(tmp_path)), False) == [mine]
        mine.unlink()


def test_files_of_no_task_of_the_run_or_of_the_same_task_are_refused(tmp_path, recorded):
    first, second = own(tmp_path / "a.hdf5"), own(tmp_path / "b.hdf5")
    for files, tasks, words in (
        ([first], TASKS[:1], "not of a task of this run"),
        ([first, second], TASKS, "of the same task"),
    ):
        with pytest.raises(DataError, match=words):
            data = replace(settings(None), files=list(map(str, files)))
            demonstrations.find_demos(tasks, [2] * len(tasks), data, False)
    with pytest.raises(DataError, match="several files"):
        demonstrations.find_demos(TASKS, [2, 2, 2], settings(str(tmp_path)), False)


def test_links_in_a_folder_are_not_followed_and_told(tmp_path, recorded, capsys):
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "folder"
    elsewhere.mkdir()
    in_layout = write_demos(elsewhere, TASKS[0], 2)
    folder.mkdir()
    (folder / TASKS[0].suite).symlink_to(in_layout.parent)  # is used
    (folder / "a.hdf5").symlink_to(own(elsewhere / "a.hdf5"))
    (folder / "more").symlink_to(elsewhere)
    demonstrations.find_demos(TASKS[:2], [2, 2], settings(str(folder)), False)
    assert recorded == [TASKS[1].name]
    links = f"{folder / 'a.hdf5'}, {folder / 'more'}"
    assert f"not used: links, which are not followed: {links}; see data.files" in capsys.readouterr().err


def test_files_may_be_of_tasks_that_are_learned_before_or_after(tmp_path, recorded):
    data = replace(settings(None), files=[str(path := own(tmp_path / "a.hdf5"))])
    assert path not in demonstrations.find_demos(TASKS[:1], [2], data, False, TASKS[1:])
    assert path in demonstrations.find_demos(TASKS[1:], [2, 2], data, False, TASKS[:1])


def test_without_a_folder_recorded_files_are_used(tmp_path, recorded, monkeypatch):
    write_demos(tmp_path, TASKS[1], 2)
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path))
    demonstrations.find_demos(TASKS, [1, 1, 1], settings(None), False)
    assert recorded == [task.name for task in TASKS]


def test_too_few_demonstrations_are_reported(tmp_path, recorded):
    write_demos(tmp_path, TASKS[0], 1)
    with pytest.raises(DataError, match="has 1 demonstrations and 2 are required"):
        demonstrations.find_demos(TASKS[:1], [2], settings(str(tmp_path)), False)
