"""Which file a task's demonstrations are read from."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from libero_env.tasks import get_suite
from lifelong.data import demonstrations
from lifelong.data.settings import DataSettings
from lifelong.errors import DataError

pytestmark = pytest.mark.unit
TASKS = get_suite("libero_object").tasks[:3]


@pytest.fixture
def recorded(monkeypatch):
    """Return the names of the tasks that would be recorded."""
    names: list[str] = []

    def ensure(tasks, n, *, root, **kwargs):
        names.extend(task.name for task in tasks)
        return [Path(root or "cache") / "ours" / f"{task.name}_{n}.hdf5" for task in tasks]

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
    return path


def test_files_in_the_originals_layout_are_used(tmp_path, recorded):
    human = write_demos(tmp_path, TASKS[1], 2)
    found = demonstrations.find_demos(TASKS, [2, 2, 1], settings(str(tmp_path)), False)
    assert found[1] == human
    assert recorded == [TASKS[0].name, TASKS[2].name]
    assert [path.name for path in found[::2]] == [f"{TASKS[0].name}_2.hdf5", f"{TASKS[2].name}_1.hdf5"]


def test_without_a_folder_recorded_files_are_used(tmp_path, recorded, monkeypatch):
    write_demos(tmp_path, TASKS[1], 2)
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path))
    demonstrations.find_demos(TASKS, [1, 1, 1], settings(None), False)
    assert recorded == [task.name for task in TASKS]


def test_too_few_demonstrations_are_reported(tmp_path, recorded):
    write_demos(tmp_path, TASKS[0], 1)
    with pytest.raises(DataError, match="has 1 demonstrations and 2 are required"):
        demonstrations.find_demos(TASKS[:1], [2], settings(str(tmp_path)), False)
