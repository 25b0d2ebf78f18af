"""Files of initial states: all files of the original can be read, and no file can execute code."""

import os
import pickle
import zipfile

import numpy as np
import pytest

from libero_env.init_states.pickles import StateFileError, read_states, write_states

pytestmark = pytest.mark.unit


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
    tensor = torch.from_numpy(rows)
    torch.save(tensor[1:, ::2], tmp_path / "tensor")
    assert (read_states(tmp_path / "tensor") == rows[1:, ::2]).all()


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
    with pytest.raises(StateFileError, match=r"evil: the pickle names posix.mkdir"):
        read_states(file)
    assert not (tmp_path / "pwned").exists()


def test_errors_name_the_broken_file(tmp_path):
    write_states(tmp_path / "good", np.zeros((3, 4)))
    whole = (tmp_path / "good").read_bytes()
    rng = np.random.default_rng(2)
    for _ in range(200):
        broken = bytearray(whole[: rng.integers(1, len(whole) + 1)])
        for at in rng.integers(len(broken), size=3):
            broken[at] = rng.integers(256)
        (tmp_path / "bad").write_bytes(broken)
        try:
            assert read_states(tmp_path / "bad").ndim == 2
        except StateFileError as error:
            assert str(tmp_path / "bad") in str(error)
    with pytest.raises(StateFileError, match="absent"):
        read_states(tmp_path / "absent")
    write_states(tmp_path / "flat", np.zeros(3))
    with pytest.raises(StateFileError, match=r"\(states, size\)"):
        read_states(tmp_path / "flat")
