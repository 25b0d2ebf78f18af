"""A run's directory: one configuration, one writer at a time, no results lost."""

import errno
import fcntl
import os
import sys
from types import SimpleNamespace

import pytest
from filelock import FileLock
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lifelong.errors import ConfigError, LifelongError
from lifelong.results.run_directory import RunDirectory
from lifelong.tracking import TensorBoard, Trackio, WandB

CONFIG = {"seed": 1, "train": {"lr": 0.1, "epochs": 3}, "device": "cpu", "runs_dir": "a"}


@pytest.fixture
def directory(tmp_path) -> RunDirectory:
    """A directory that a run has had."""
    directory = RunDirectory(tmp_path / "run")
    with directory.opened(CONFIG, resume=True):
        return directory


def test_keys_that_change_no_result_may_differ(directory):
    with directory.opened(CONFIG | {"device": "cuda", "runs_dir": "b"}, resume=True):
        assert (directory.path / "config.yaml").exists()


def test_another_configuration_is_refused_with_the_difference_and_the_remedy(directory):
    other = CONFIG | {"train": {"lr": 0.2, "epochs": 3}}
    message = r"train\.lr 0\.1 -> 0\.2.*run_id=NAME"
    with pytest.raises(ConfigError, match=message), directory.opened(other, resume=True):
        pass


def test_a_broken_configuration_is_one_line_with_its_file(directory):
    (directory.path / "config.yaml").write_text("a: [")
    with pytest.raises(ConfigError, match=r"config\.yaml") as found, directory.opened(CONFIG, resume=True):
        pass
    assert "\n" not in str(found.value)
    with directory.opened(CONFIG, resume=False):
        assert (directory.path / "config.yaml").read_text() != "a: ["


@pytest.mark.parametrize("name", ["videos", "checkpoints"])
@pytest.mark.parametrize("target", ["elsewhere", "nowhere", "run/videos/a"])
def test_a_folder_that_is_a_link_out_of_the_run_is_refused_and_nothing_there_changes(
    directory, tmp_path, name, target
):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".a.part").touch()
    (directory.path / name).symlink_to(tmp_path / target)
    if target.startswith("run"):
        (directory.path / name).unlink()
        (directory.path / name).symlink_to(directory.path / name)  # in a circle
    message = f"{name} is a link, or is not a folder"
    with pytest.raises(ConfigError, match=message), directory.opened(CONFIG, resume=True):
        pass
    assert (elsewhere / ".a.part").exists()


def test_starting_again_keeps_the_old_run(directory, tmp_path):
    for lr in (0.2, 0.3):
        with directory.opened(CONFIG | {"train": {"lr": lr}}, resume=False):
            pass
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["run", "run.old1", "run.old2"]


def test_a_second_writer_is_refused(directory):
    second = RunDirectory(directory.path)
    with directory.opened(CONFIG, resume=True):  # noqa: SIM117
        with pytest.raises(LifelongError, match="another process is"), second.opened(CONFIG, resume=True):
            pass


def test_a_file_system_without_locks_is_named(directory, monkeypatch) -> None:
    def no_locks(*_, **__) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(FileLock, "acquire", no_locks)
    message = "cannot lock files .No locks available"
    with pytest.raises(ConfigError, match=message), directory.opened(CONFIG, resume=True):
        pass


@pytest.mark.parametrize("left", [False, True])
def test_a_marker_is_no_lock(directory, monkeypatch, left) -> None:
    """It would stay where a machine is lost."""

    def no_flock(*_) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", no_flock)
    directory.path.parent.mkdir(parents=True, exist_ok=True)
    if left:
        directory.path.with_name(f".{directory.path.name}.lock").write_text("4711\nanother-host\n")
    with (
        pytest.warns(UserWarning, match="flock not supported"),
        pytest.raises(ConfigError, match="cannot lock files"),
        directory.opened(CONFIG, resume=True),
    ):
        pass


def test_tensorboard_reads_what_two_starts_of_a_run_logged(tmp_path):
    for step in (1, 2):  # a killed run, and its resumption
        tracker = TensorBoard()
        tracker.start("run", str(tmp_path), {})
        tracker.log({"loss/0": 1.0 / step}, step)
        tracker.finish()
    read = EventAccumulator(str(tmp_path / "tensorboard"))
    read.Reload()
    assert [(e.step, e.value) for e in read.Scalars("loss/0")] == [(1, 1.0), (2, 0.5)]
    (tmp_path / "file").touch()
    with pytest.raises(LifelongError, match="TensorBoard's files cannot be written"):
        tracker.start("run", str(tmp_path / "file"), {})


def test_wandb_keeps_the_steps_in_the_directory_of_the_run(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_SILENT", "true")
    tracker = WandB(mode="offline")
    tracker.start("libero_object/er", str(tmp_path), {"seed": 1})
    tracker.log({"loss/0": 0.5}, 3)
    assert tracker._run.step == 3 and tracker._run.id.startswith("libero_object-er-")
    tracker.finish()
    assert list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))


def test_trackers_tell_apart_runs_of_one_name_in_other_folders_and_begun_anew(tmp_path, monkeypatch):
    """A killed run goes on under its identity."""
    seen = []
    fake = SimpleNamespace(init=lambda **how: seen.append(how.get("id") or how["name"]), Error=OSError)
    for number, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "config.yaml").write_text("")
        os.utime(tmp_path / folder / "config.yaml", ns=(0, number))
    for kind, package in ((WandB, "wandb"), (Trackio, "trackio")):
        monkeypatch.setitem(sys.modules, package, fake)
        tracker = object.__new__(kind)
        vars(tracker).update(mode="offline", project="p", entity=None, space_id=None)
        for folder in ("a", "a", "b"):
            tracker.start("libero_object/er", str(tmp_path / folder), {})
        (tmp_path / "b" / "config.yaml").write_text("")  # as by resume=false
        tracker.start("libero_object/er", str(tmp_path / "b"), {})
        first, again, other, anew = seen[-4:]
        assert first == again and len({first, other, anew}) == 3
        os.utime(tmp_path / "b" / "config.yaml", ns=(0, 1))


def test_wandb_ends_a_run_with_an_error_as_failed():
    codes, tracker = [], WandB(mode="offline")
    tracker._run = SimpleNamespace(finish=lambda exit_code: codes.append(exit_code))
    tracker.finish()
    with pytest.raises(LifelongError):
        try:
            raise LifelongError
        finally:
            tracker.finish()
    assert codes == [0, 1]
