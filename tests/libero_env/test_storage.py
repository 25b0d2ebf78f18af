"""Files and folders that are replaced in one step."""

import shutil

import pytest

from libero_env.storage import atomic_folder, atomic_path, atomic_write_text, create_text, files_below


@pytest.mark.parametrize("fsync", [False, True])
def test_a_file_is_replaced_when_it_is_complete(tmp_path, fsync):
    target = tmp_path / "new" / "file.txt"
    atomic_write_text(target, "old", fsync=fsync)
    with atomic_path(target, fsync=fsync) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert list(target.parent.iterdir()) == [target]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "file.txt"
    atomic_write_text(target, "old")
    with pytest.raises(OSError, match="disk full"), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise OSError("disk full")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_two_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    target = tmp_path / "file.txt"
    with atomic_path(target) as first:
        first.write_text("first")
        with atomic_path(target) as second:
            second.write_text("second")
        assert target.read_text() == "second"
    assert target.read_text() == "first"


def test_of_several_writers_the_first_one_wins(tmp_path, monkeypatch):
    target = tmp_path / "new" / "file.txt"
    assert create_text(target, "first") and not create_text(target, "second")
    assert target.read_text() == "first"
    monkeypatch.setattr(type(target), "exists", lambda path: False)  # both looked before either had written
    assert not create_text(target, "third")
    assert target.read_text() == "first" and list(target.parent.iterdir()) == [target]


def test_a_file_is_written_once_where_there_are_no_hard_links(tmp_path, monkeypatch):
    def link(*_):
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr("os.link", link)
    target = tmp_path / "file.txt"
    assert create_text(target, "first") and not create_text(target, "second")
    assert target.read_text() == "first" and list(tmp_path.iterdir()) == [target]


def test_a_folder_gets_its_name_when_it_is_complete(tmp_path):
    target = tmp_path / "data"
    (tmp_path / ".data.part").mkdir()
    (tmp_path / ".data.part" / "left_by_a_killed_process").touch()
    with atomic_folder(target) as temporary:
        (temporary / "a").touch()
        assert not target.exists()
    assert [path.name for path in target.iterdir()] == ["a"]
    with pytest.raises(ValueError), atomic_folder(tmp_path / "other") as temporary:
        (temporary / "a").touch()
        raise ValueError
    assert list(tmp_path.iterdir()) == [target]


def test_folders_that_vanish_while_files_are_looked_for_hold_none(tmp_path):
    for name in "abc":
        atomic_write_text(tmp_path / name / "inside" / "file.hdf5", "")
    found = files_below(tmp_path, "*.hdf5")
    first = next(found)
    for folder in tmp_path.iterdir():
        if folder not in first.parents:
            shutil.rmtree(folder)
    assert list(found) == []
