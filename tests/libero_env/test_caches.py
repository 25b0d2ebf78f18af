"""Caches: whatever has happened to a file, the arrays are the same, and nothing stops for it."""

import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from libero_env import compilation, get_task, read_task, storage
from libero_env.errors import BrokenFileError, LiberoError
from libero_env.init_states import store
from libero_env.paths import cache_dir, config_file, demos_dir, read_config
from libero_env.sim.scene import build_scene
from libero_env.storage import atomic_write_npz, cached_arrays, read_npz, read_record, write_record

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.arange(300, dtype=np.int32), "name": np.array("é")}


class Source:
    """Arrays for a cache, counted as often as they are made."""

    made = 0

    def get(self, path: Path) -> dict[str, np.ndarray]:
        def make():
            self.made += 1
            return ARRAYS

        return cached_arrays(path, make, lambda found: {k: v.shape for k, v in found.items()} == SHAPES)


SHAPES = {name: array.shape for name, array in ARRAYS.items()}


def assert_same(found: dict[str, np.ndarray]) -> None:
    said = [{name: (a.dtype, a.tobytes()) for name, a in arrays.items()} for arrays in (found, ARRAYS)]
    assert said[0] == said[1]


@pytest.fixture
def source():
    return Source()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache" / "kind" / "file.npz"


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.WARNING)
    return lambda: [record.getMessage() for record in caplog.records]


def test_arrays_are_made_once_and_every_reader_knows_them(path, source, lines):
    for _ in range(2):
        assert_same(source.get(path))
    assert source.made == 1 and lines() == []
    assert [file.name for file in path.parent.iterdir()] == ["file.npz"]
    with np.load(path, allow_pickle=False) as stored:
        assert_same(dict(stored))


def middle_bit(content: bytes) -> bytes:
    half = len(content) // 2
    return content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "bit": lambda path: path.write_bytes(middle_bit(path.read_bytes())),
    "text": lambda path: path.write_bytes(b"<html>not found</html>"),
    "other": lambda path: atomic_write_npz(path, ARRAYS | {"a": np.zeros(3)}),
    "not finite": lambda path: atomic_write_npz(path, ARRAYS | {"a": np.full((2, 3), np.nan)}),
    "without a checksum": lambda path: np.savez_compressed(path, **ARRAYS),
    "objects": lambda path: np.savez(path, **{**ARRAYS, "a": np.full((2, 3), None)}),
}


@pytest.mark.parametrize("how", DAMAGES)
def test_a_broken_file_is_made_again_with_one_line(path, source, lines, how):
    source.get(path)
    whole = path.read_bytes()
    DAMAGES[how](path)
    assert_same(source.get(path))
    assert source.made == 2 and path.read_bytes() == whole
    (line,) = lines()
    assert line.startswith(str(path)) and line.endswith("it is made again")


def test_a_file_that_unpacks_to_more_than_memory_is_refused(path):
    path.parent.mkdir(parents=True)
    header = np.lib.format.magic(1, 0) + b"\x76\x00"
    header += b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header + bytes(8))
    with pytest.raises(BrokenFileError, match="of another size"):
        read_npz(path)
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no place on the disk
    with pytest.raises(BrokenFileError, match=r"at most 1\.1 GB"):
        read_npz(path)


@pytest.mark.parametrize("kind", ["file", "no permission"])
def test_without_a_place_for_it_everything_works_with_one_line(tmp_path, source, lines, kind):
    root = tmp_path / "cache"
    if kind == "file":
        root.write_text("")
    else:
        root.symlink_to("/proc/1")  # where not even root may write
    for name in ("x.npz", "y.npz"):
        assert_same(source.get(root / "kind" / name))
    (line,) = lines()
    assert source.made == 2 and line.startswith(f"nothing is cached in {root}")
    assert line.endswith("that you can write to")


def test_what_killed_processes_have_left_is_removed(path, source):
    path.parent.mkdir(parents=True)
    old, young = (path.parent / f".file.npz.{name}.part" for name in ("old", "young"))
    for part in (old, young):
        part.write_text("")
    os.utime(old, (0, 0))
    source.get(path)
    assert young.exists() and not old.exists()


def full(*_):
    raise OSError(28, "No space left on device")


def test_a_full_disk_leaves_no_part_of_a_file(path, source, lines, monkeypatch):
    monkeypatch.setattr(os, "fsync", full)
    assert_same(source.get(path))
    assert list(path.parent.iterdir()) == [] and "No space left" in lines()[0]


@pytest.mark.parametrize(("mask", "file", "folder"), [(0, 0o644, 0o755), (0o077, 0o600, 0o700)])
def test_nothing_is_writable_by_others_whatever_the_mask(path, source, mask, file, folder):
    before = os.umask(mask)
    try:
        source.get(path)
        write_record(path.with_suffix(".json"), {"a": 1})
    finally:
        os.umask(before)
    made = [path, path.with_suffix(".json"), path.parent, path.parent.parent]
    assert [one.stat().st_mode & 0o777 for one in made] == [file, file, folder, folder]


def test_a_folder_where_everybody_writes_is_not_read(path, source, lines):
    source.get(path)
    path.parent.chmod(0o777)
    with pytest.raises(LiberoError, match="writable by every user: chmod"):
        storage.check_trusted(path.parent)
    for _ in range(2):
        assert_same(source.get(path))
    assert source.made == 3 and len(lines()) == 1
    with pytest.raises(LiberoError, match="writable by every user"):
        storage.cached_folder(path.parent / "folder", lambda: None)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes files of others")
@pytest.mark.parametrize(
    ("mode", "owner", "trusted"), [(0o1777, 12345, False), (0o755, 0, False), (0o755, 12345, True)]
)
def test_a_folder_of_another_user_is_read_where_the_cache_is_theirs(path, source, mode, owner, trusted):
    storage.make_cache_folder(path.parent)
    os.chown(path.parent, 12345, -1)
    os.chown(path.parent.parent, owner, -1)
    path.parent.parent.chmod(mode)
    source.get(path)
    assert path.exists() == trusted


def test_records_have_a_checksum(tmp_path):
    path = tmp_path / "file.json"
    write_record(path, {"b": [1, 2], "a": "é"})
    assert read_record(path) == {"b": [1, 2], "a": "é"}
    path.write_text(path.read_text().replace("2", "3", 1))
    assert read_record(path) is None
    for text in ("", "[]", "{}", "[" * 100_000, '{"sha256": 1}'):
        path.write_text(text)
        assert read_record(path) is None


def test_paths_of_the_cache(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("LIBERO_DEMOS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which its specification says to ignore
    for value, expected in (("", "home/.cache/libero"), ("~/x", "home/x"), ("x", "x"), (str(tmp_path), ".")):
        monkeypatch.setenv("LIBERO_CACHE", value)
        assert cache_dir() == tmp_path / expected
        assert demos_dir() == tmp_path / expected / "demos"
    monkeypatch.setenv("LIBERO_DEMOS", "elsewhere")
    monkeypatch.setenv("LIBERO_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert (demos_dir(), cache_dir()) == (tmp_path / "elsewhere", tmp_path / "xdg" / "libero")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("LIBERO_CACHE", "~nobody-of-this-name/x")
    with pytest.raises(LiberoError, match="set LIBERO_CACHE"):
        cache_dir()


@pytest.mark.parametrize(("text", "message"), [
    ("assets: 5", r"config.yaml:1: assets is 5; expected a valid string"), ("- a", "expected an object"),
    ("assets: [1", "not valid YAML")
])  # fmt: skip
def test_a_broken_configuration_file_is_one_line(tmp_path, monkeypatch, text, message):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    config_file().write_text(text)
    with pytest.raises(LiberoError, match=message) as caught:
        read_config()
    assert "\n" not in str(caught.value)


def test_values_that_are_not_used_may_be_anything(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    config_file().write_text("mine: [1, 2]\nassets: /x\nobjects:\n")
    assert read_config() == {"assets": "/x"}


def test_a_broken_file_of_the_package_is_named(tmp_path, monkeypatch):
    path = tmp_path / "libero_spatial.npz"
    monkeypatch.setattr(store, "shipped_path", lambda suite: path)
    path.write_bytes(b"")
    with pytest.raises(BrokenFileError, match=r"spatial\.npz is not a file of .* install the package again"):
        store.packaged_states.__wrapped__("libero_spatial")
    atomic_write_npz(path, {"x": np.zeros((2, 3))})
    with pytest.raises(BrokenFileError, match="no digest of x"):
        store.packaged_states.__wrapped__("libero_spatial")


@pytest.mark.sim
@pytest.mark.parametrize("columns", [0, 1], ids=["truncated", "of another model"])
def test_broken_initial_states_are_generated_again(tmp_path, monkeypatch, lines, columns):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    (tmp_path / "task.bddl").write_text(get_task("libero_spatial/0").bddl_text)
    task = read_task(tmp_path / "task.bddl")
    scene = build_scene(task.problem)
    width = 1 + scene.model.nq + scene.model.nv + 7 * len(scene.fixtures)
    states = np.random.default_rng(0).normal(size=(50, width))
    monkeypatch.setattr(store, "generate_init_states", lambda *_: states)
    store.load_init_states(task, scene)
    (path,) = (tmp_path / "cache" / "init_states").iterdir()
    path.write_bytes(path.read_bytes()[:300])
    if columns:
        atomic_write_npz(path, {"states": states[:, columns:]})
    assert (store.load_init_states(task, scene) == states).all() and len(lines()) == 1
    assert (read_npz(path)["states"] == states).all()


@pytest.fixture
def function(tmp_path, monkeypatch):
    """Return a function of a module of its own, whose machine code is cached in this test's folder."""
    for name in ("_warn_uncached", "_tell", "_lock"):
        monkeypatch.setattr(compilation, name, lru_cache(getattr(compilation, name).__wrapped__))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (tmp_path / "module.py").write_text("def twice(x):\n    return 2 * x\n")
    spec = importlib.util.spec_from_file_location("module", tmp_path / "module.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("size", [0, 10])
def test_compiled_functions_that_are_damaged_are_compiled_again(tmp_path, function, lines, kind, size):
    assert compilation.compiled(function)(2) == 4
    (file,) = tmp_path.glob(f"compiled/*/*.{kind}")
    file.write_bytes(file.read_bytes()[:size])
    assert compilation.compiled(function)(3) == 6
    (line,) = lines()
    assert "twice" in line and line.endswith("compiled again")
    again = compilation.compiled(function)
    assert again(4) == 8 and sum(again.dispatcher.stats.cache_hits.values()) == 1


def test_functions_are_compiled_where_nothing_can_be_cached(tmp_path, function, lines):
    (tmp_path / "compiled").write_text("no folder")
    assert [compilation.compiled(function)(x) for x in (1, 2)] == [2, 4]
    (line,) = lines()
    assert "Set NUMBA_CACHE_DIR" in line


def test_machine_code_that_others_can_write_is_not_run(tmp_path, function, lines):
    assert compilation.compiled(function)(1) == 2
    (tmp_path / "compiled").chmod(0o777)
    again = compilation.compiled(function)
    assert again(2) == 4 and not again.dispatcher.stats.cache_hits
    assert "writable by every user" in lines()[0]


def test_functions_are_compiled_where_the_disk_is_full(function, lines, monkeypatch):
    made = compilation.compiled(function)
    monkeypatch.setattr(os, "replace", full)
    assert made(1) == 2 and "No space left on device" in lines()[0]


COMPILING = """
import sys
sys.path.insert(0, sys.argv[1])
import module
from libero_env.compilation import compiled
sys.stdin.readline()
twice = compiled(module.twice)
print(twice(2), sum(twice.dispatcher.stats.cache_hits.values()))
"""


def test_several_environments_compile_once_for_a_user_and_say_so_once(tmp_path, function):
    """Each process imports a copy of its own, as those of several environments do; one compiles, the others wait."""
    homes = [tmp_path / str(k) for k in range(3)]
    for home in homes:
        home.mkdir()
        shutil.copy(tmp_path / "module.py", home)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([sys.executable, "-c", COMPILING, str(home)], **pipes) for home in homes]
    answers = [process.communicate("go\n", timeout=300) for process in processes]
    assert sorted(out for out, _ in answers) == ["4 0\n", "4 1\n", "4 1\n"]
    assert "".join(err for _, err in answers).count("compiling, once for this user") == 1
    assert len(list(tmp_path.glob("compiled/module-*"))) == 1


MAKER = """
import sys, time
from libero_env.storage import cached_folder
from pathlib import Path
folder, log, kill = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "kill"

def make():
    with log.open("a") as file:
        file.write("made\\n")
    if kill:
        print("making", flush=True)
        time.sleep(600)
    time.sleep(0.2)
    folder.mkdir()
    (folder / "file").write_text("content")

cached_folder(folder, make)
"""


def test_one_process_makes_a_folder_and_one_that_is_killed_holds_nobody_up(tmp_path):
    folder, log = tmp_path / "cache" / "kind" / "folder", tmp_path / "log"
    command = [sys.executable, "-c", MAKER, str(folder), str(log)]
    killed = subprocess.Popen([*command, "kill"], stdout=subprocess.PIPE)
    assert killed.stdout.readline() == b"making\n"
    killed.kill()
    killed.communicate()
    processes = [subprocess.Popen([*command, "go on"]) for _ in range(4)]
    assert [process.wait(timeout=120) for process in processes] == [0] * 4
    assert log.read_text() == "made\n" * 2
    assert (folder / "file").read_text() == "content"
