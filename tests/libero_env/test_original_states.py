"""Files of initial states: all files of the original can be read, and no file can execute code."""

import os
import pickle
import tracemalloc
import zipfile

import numpy as np
import pytest

from libero_env.errors import LiberoError
from libero_env.init_states.pickles import StateFileError, read_states, write_states
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_task


def test_reads_every_original_file(shared):
    files = sorted((shared / "official" / "init_files").glob("*/*.pruned_init"))
    assert len(files) == 130
    for file in files:
        rows = read_states(file)
        assert len(rows) == 50
        assert rows.dtype == np.float64
        assert np.abs(rows[:, 1:8]).max() < np.pi


def test_round_trip_and_equal_files(tmp_path):
    rows = np.random.default_rng(0).normal(size=(5, 12))
    for name in ("a", "b"):
        write_states(tmp_path / name / "x.pruned_init", rows)
    assert (read_states(tmp_path / "a" / "x.pruned_init") == rows).all()
    assert (tmp_path / "a" / "x.pruned_init").read_bytes() == (tmp_path / "b" / "x.pruned_init").read_bytes()


def test_torch_reads_what_we_write_and_we_what_torch_writes(tmp_path):
    torch = pytest.importorskip("torch")
    rows = np.random.default_rng(1).normal(size=(4, 7))
    write_states(tmp_path / "ours", rows)
    assert (torch.load(tmp_path / "ours", weights_only=False) == rows).all()
    torch.save(rows, tmp_path / "array")
    assert (read_states(tmp_path / "array") == rows).all()


class Malice:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("zipped", [True, False])
def test_pickles_that_call_functions_are_errors(tmp_path, zipped):
    content = pickle.dumps(Malice(tmp_path / "pwned"), protocol=2)
    file = tmp_path / "evil"
    if zipped:
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("evil/data.pkl", content)
    else:
        file.write_bytes(content)
    with pytest.raises(StateFileError, match=r"evil: the pickle names 'posix.mkdir'"):
        read_states(file)
    assert not (tmp_path / "pwned").exists()


def test_a_rejected_file_changes_nothing_for_the_next(tmp_path):
    torch = pytest.importorskip("torch")
    torch.save(np.arange(12.0).reshape(3, 4), tmp_path / "good")
    expected = read_states(tmp_path / "good")
    # sets an attribute of what the name stands for
    evil = b"\x80\x02cnumpy\nndarray\n}X\x05\x00\x00\x00dtypeK\x01sb."
    (tmp_path / "evil").write_bytes(evil)
    with pytest.raises(StateFileError, match="evil"):
        read_states(tmp_path / "evil")
    assert (read_states(tmp_path / "good") == expected).all()


def memory_peak(path) -> int:
    """Return the memory that Python asks for while it refuses a file, in bytes."""
    tracemalloc.start()
    try:
        with pytest.raises(StateFileError, match=path.name):
            read_states(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_small_files_do_not_ask_for_much_memory(tmp_path):
    # a length of 32 GB; an entry of the memory that would need a table of 4 GB
    (tmp_path / "length").write_bytes(b"\x80\x04\x8e" + (1 << 35).to_bytes(8, "little") + b"x")
    (tmp_path / "entry").write_bytes(b"\x80\x02K\x01r\xff\xff\xff\x0f.")
    (tmp_path / "many").write_bytes(b"\x80\x02" + b"(" * 1_000_000 + b".")
    with zipfile.ZipFile(tmp_path / "packed", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("x/data.pkl", bytes((1 << 28) + 1))
    for name in ("length", "entry", "many", "packed"):
        assert memory_peak(tmp_path / name) < 20e6, name


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_states_are_finite_numbers(tmp_path, value):
    write_states(tmp_path / "file", np.full((2, 3), value))
    with pytest.raises(StateFileError, match="file: .* not finite"):
        read_states(tmp_path / "file")


def test_states_of_another_model_are_one_line():
    scene = build_scene(get_task("libero_goal/0").problem)
    size = 1 + scene.model.nq + scene.model.nv
    with pytest.raises(LiberoError, match=rf"^file: states of {size - 1} numbers; .* begin with {size} "):
        scene.check_states(np.zeros((2, size - 1)), "file")
    with pytest.raises(LiberoError, match=f"{size + 1} numbers"):
        scene.split_states(np.zeros((2, size + 1)))


def test_what_is_no_file_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")  # reading it would wait for ever
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero"):
        with pytest.raises(StateFileError, match="expected a file"):
            read_states(path)


def test_errors_name_the_broken_file(tmp_path):
    write_states(tmp_path / "good", np.zeros((3, 4)))
    whole = (tmp_path / "good").read_bytes()
    (tmp_path / "bad").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StateFileError, match="bad"):
        read_states(tmp_path / "bad")
    with pytest.raises(StateFileError, match="absent"):
        read_states(tmp_path / "absent")
    write_states(tmp_path / "cube", np.zeros((3, 4, 5)))
    with pytest.raises(StateFileError, match=r"\(states, size\)"):
        read_states(tmp_path / "cube")


def test_a_single_state_may_be_an_array_of_one_dimension(tmp_path):
    write_states(tmp_path / "flat", np.arange(5.0))
    np.testing.assert_array_equal(read_states(tmp_path / "flat"), [np.arange(5.0)])
