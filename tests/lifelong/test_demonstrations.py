"""Which file a task's demonstrations are read from."""

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from libero._adapters.controllers import controller_of
from libero_env.assets.pack import select_pack
from libero_env.curating.curate import examine
from libero_env.demos.agreement import other_control
from libero_env.demos.config import GENERATOR
from libero_env.errors import LiberoError
from libero_env.storage import read_yaml
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


def settings(folder, despite=("expert", "labels")):
    what = {"demos": 2, "image_size": 8, "seq_len": 1, "views": ["agentview_rgb"], "proprio": []}
    return DataSettings(**what, folder=folder, despite=despite)


def models(**changed):
    pack = select_pack()
    return json.dumps({"pack": pack.name, "digest": pack.digest} | changed)


def made_with(**kwargs):
    return {"env_args": json.dumps({"env_kwargs": kwargs})}


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
        file["data"].attrs["models"] = models()
    demonstrations.find_demos(TASKS, [2, 2, 1], data, False)
    assert "whose models" not in capsys.readouterr().err


def own(path, task=TASKS[1], demos=2, size=8, intended=range(9), **more):
    """Write demonstrations of a task under any name; `intended` are the numbers of those with `expert_actions`."""
    stated = {"bddl_file_name": f"x/{task.name}.bddl", "bddl_file_content": task.bddl_text}
    episodes = [episode(i, size=size) for i in range(demos)]
    episodes = [e if i in intended else replace(e, expert_actions=None) for i, e in enumerate(episodes)]
    return write(path, episodes, **stated, **more)


EXPERT = {"generator": "scripted-expert-3", "disturbed": True, "robot": "libero"}


@pytest.mark.parametrize(("name", "second", "both"), [
    ("expert", EXPERT | {"generator": GENERATOR}, "scripted-expert-3 of {}, " + GENERATOR + " of {}"),
    ("labels", EXPERT | {"generator": "teleoperation", "intended": ()}, "intended of {}, executed of {}"),
    ("", EXPERT | {"disturbed": False, "intended": ()}, ""),  # of which the executed actions are the intended ones
    ("models", EXPERT | {"models": models(digest="0" * 16)}, "0000000000000000"),
])  # fmt: skip
def test_what_differs_between_files_is_refused_unless_it_is_allowed(name, second, both, tmp_path, recorded):
    files = [
        own(tmp_path / "a.hdf5", TASKS[0], **EXPERT, models=models()),
        own(tmp_path / "b.hdf5", TASKS[1], **{"models": models(), **second}),
    ]
    data = replace(settings(None, ()), files=[*map(str, files)])
    find = lambda data: demonstrations.find_demos(TASKS[:2], [2, 2], data, False)  # noqa: E731
    if not name:
        assert find(data) == files
        return
    with pytest.raises(LiberoError, match=re.escape(both.format(*files))) as caught:
        find(data)
    allowed = replace(data, despite=re.findall(r"data.despite=\[(.*?)\]", str(caught.value))[0].split(","))
    assert find(allowed) == files and not recorded
    if name in ("expert", "labels"):  # what will be recorded is compared before it is
        with pytest.raises(LiberoError, match=f"{GENERATOR} of what is recorded"):
            demonstrations.find_demos(
                TASKS[:1] + TASKS[2:], [2, 2], replace(data, files=[str(files[0])]), False
            )
        assert not recorded


def test_default_controllers_of_the_original_are_taken(tmp_path, recorded):
    """Those that its recordings state, this package's and what robosuite 1.4 makes of a name; absent keys, too."""
    ranges = {"input_max": 1, "input_min": -1, "output_max": [0.05] * 3 + [0.5] * 3}
    gains = {
        "kp": 150,
        "damping_ratio": 1,
        "impedance_mode": "fixed",
        "control_delta": True,
        "ramp_ratio": 0.2,
    }
    limits = {"kp_limits": [0, 300], "damping_ratio_limits": [0, 10], "uncouple_pos_ori": True}
    none = dict.fromkeys(("position_limits", "orientation_limits", "interpolation"))
    whole = {"type": "OSC_POSE", **ranges, **gains, **limits, **none}
    for number, stated in enumerate((
        whole, [whole], {"type": "OSC_POSE"}, "OSC_POSE", {}, None, {"kp": [150.0] * 6}, controller_of("OSC_POSE"),
        read_yaml("demos/original_env.yaml")["controller_configs"],
    )):  # fmt: skip
        path = own(
            tmp_path / f"{number}.hdf5", **made_with(controller_configs=stated, robots=["OnTheGroundPanda"])
        )
        assert demonstrations.find_demos(
            TASKS[1:2], [2], replace(settings(None, ()), files=[str(path)]), False
        )
        assert other_control(path) == "" and not examine(path).notes


def test_named_files_are_found_by_the_task_that_they_state(tmp_path, recorded):
    path = own(tmp_path / "deep" / "whatever.hdf5")
    data = replace(settings(None), files=[str(path)])
    assert demonstrations.find_demos(TASKS, [2, 2, 2], data, False)[1] == path
    assert recorded == [TASKS[0].name, TASKS[2].name]
    with pytest.raises(DataError, match="whatever.hdf5 is not used.*name it in data.files"):
        demonstrations.find_demos(TASKS, [2, 2, 2], settings(str(tmp_path)), False)
    path.unlink()
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
    ({"models": models(pack="moon")}, "those of this run are"),
    ({"generator": "teleoperation", "robot": "libero", "intended": (0,)}, "has no expert_actions in demo_1"),
    (made_with(controller_configs={"type": "OSC_POSE", "control_delta": False}), "control_delta False"),
    (made_with(controller_configs="JOINT_POSITION"), "type 'JOINT_POSITION' of the controller; expected 'OSC_POSE'"),
    (made_with(controller_configs=[{"output_max": 1}]), "output_max 1"),
    (made_with(controller_configs={"input_type": "delta"}), "input_type 'delta' of the controller; expected no such"),
    (made_with(robots=["Sawyer"]), "the robots ['Sawyer']"),
    (made_with(control_freq=10), "was recorded at 10 Hz"),
    ({"variation": '{"reserved": true}'}, "stored initial states, from which policies are evaluated"),
])  # fmt: skip
def test_demonstrations_that_do_not_fit_are_refused_by_name(kwargs, words, tmp_path, recorded):
    path = own(tmp_path / "mine.hdf5", **kwargs)
    data = replace(settings(None), files=[str(path)], seed=1)
    with pytest.raises(DataError, match=rf"mine.hdf5 .*{re.escape(words)}"):
        demonstrations.find_demos(TASKS, [2, 2, 2], data, False)
    (tmp_path / "layout" / TASKS[1].suite).mkdir(parents=True)
    file = path.rename(tmp_path / "layout" / TASKS[1].suite / f"{TASKS[1].name}_demo.hdf5")
    with pytest.raises(DataError, match=re.escape(f"data.folder: {file} ") + f".*{re.escape(words)}"):
        in_layout = replace(settings(str(tmp_path / "layout")), seed=1)
        demonstrations.find_demos(TASKS, [2, 2, 2], in_layout, False)
    assert not recorded


def test_a_file_in_the_layout_is_refused_where_it_states_another_task(tmp_path, recorded):
    (tmp_path / TASKS[1].suite).mkdir()
    own(tmp_path / TASKS[1].suite / f"{TASKS[1].name}_demo.hdf5", TASKS[0])
    with pytest.raises(DataError, match=f"is of '{TASKS[0].name}', not of '{TASKS[1].name}'"):
        demonstrations.find_demos(TASKS, [2, 2, 2], settings(str(tmp_path)), False)


def test_files_of_no_task_of_the_run_or_of_the_same_task_are_refused(tmp_path, recorded):
    first, second = own(tmp_path / "a.hdf5"), own(tmp_path / "b.hdf5")
    for files, tasks, words in (
        ([first], TASKS[:1], "not of a task of this run"),
        ([first, second], TASKS, "of the same task"),
    ):
        with pytest.raises(DataError, match=words):
            data = replace(settings(None), files=list(map(str, files)))
            demonstrations.find_demos(tasks, [2] * len(tasks), data, False)


def test_without_a_folder_recorded_files_are_used(tmp_path, recorded, monkeypatch):
    write_demos(tmp_path, TASKS[1], 2)
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path))
    demonstrations.find_demos(TASKS, [1, 1, 1], settings(None), False)
    assert recorded == [task.name for task in TASKS]
