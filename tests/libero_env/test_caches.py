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

from libero_env import compilation
from libero_env.assets import published, simplify
from libero_env.errors import BrokenFileError, LiberoError
from libero_env.init_states import store
from libero_env.paths import cache_dir, config_file, demos_dir, read_config
from libero_env.sim.scene import build_scene
from libero_env.storage import (
    atomic_write_npz,
    cached_arrays,
    check_trusted,
    make_cache_folder,
    read_npz,
    read_record,
    write_record,
)
from libero_env.tasks import get_task, read_task

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.arange(300, dtype=np.int32), "name": np.array("é")}


class Source:
    """Arrays for a cache, counted as often as they are made."""

    def __init__(self):
        self.made = 0

    def get(self, path: Path) -> dict[str, np.ndarray]:
        def make():
            self.made += 1
            return ARRAYS

        return cached_arrays(path, make, lambda found: {k: v.shape for k, v in found.items()} == SHAPES)


SHAPES = {name: array.shape for name, array in ARRAYS.items()}


def assert_same(found: dict[str, np.ndarray]) -> None:
    assert {name: (a.dtype, a.tobytes()) for name, a in found.items()} == {
        name: (a.dtype, a.tobytes()) for name, a in ARRAYS.items()
    }


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


def damage(path: Path, how: str) -> None:
    content = path.read_bytes()
    half = len(content) // 2
    if how == "other":
        atomic_write_npz(path, ARRAYS | {"a": np.zeros(3)})
    elif how == "not finite":
        atomic_write_npz(path, ARRAYS | {"a": np.full((2, 3), np.nan)})
    elif how == "without a checksum":
        np.savez_compressed(path, **ARRAYS)
    elif how == "objects":
        np.savez(path, **{**ARRAYS, "a": np.full((2, 3), None)})
    else:
        new = {
            "empty": b"",
            "truncated": content[:half],
            "bit": content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :],
            "zeros": content[:half] + bytes(len(content) - half),
            "text": b"<html>not found</html>",
        }
        path.write_bytes(new[how])


KINDS = ("empty", "truncated", "bit", "zeros", "text", "other", "not finite", "objects", "without a checksum")


@pytest.mark.parametrize("how", KINDS)
def test_a_broken_file_is_made_again_with_one_line(path, source, lines, how):
    source.get(path)
    whole = path.read_bytes()
    damage(path, how)
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


@pytest.mark.parametrize("kind", ["file", "no permission", "link to nowhere"])
def test_without_a_place_for_it_everything_works_with_one_line(tmp_path, source, lines, kind):
    root = tmp_path / "cache"
    if kind == "file":
        root.write_text("")
    elif kind == "link to nowhere":
        root.symlink_to(tmp_path / "absent" / "deeper")
        (tmp_path / "absent").write_text("")
    else:
        root.symlink_to("/proc/1")  # where not even root may write
    for name in ("x.npz", "y.npz"):
        assert_same(source.get(root / "kind" / name))
    assert source.made == 2
    (line,) = lines()
    assert line.startswith(f"nothing is cached in {root}") and line.endswith("that you can write to")


def test_what_killed_processes_have_left_is_removed(path, source):
    path.parent.mkdir(parents=True)
    old, young = (path.parent / f".file.npz.{name}.part" for name in ("old", "young"))
    for part in (old, young):
        part.write_text("")
    os.utime(old, (0, 0))
    source.get(path)
    assert young.exists() and not old.exists()


def test_a_full_disk_leaves_no_part_of_a_file(path, source, lines, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert_same(source.get(path))
    assert list(path.parent.iterdir()) == [] and "No space left" in lines()[0]


def test_a_folder_that_is_removed_meanwhile_is_made_again(path, source):
    source.get(path)
    path.unlink()
    path.parent.rmdir()
    assert_same(source.get(path))
    assert source.made == 2 and path.exists()


def test_nothing_is_writable_by_others_whatever_the_mask(path, source):
    before = os.umask(0)
    try:
        source.get(path)
        write_record(path.with_suffix(".json"), {"a": 1})
    finally:
        os.umask(before)
    made = [path, path.with_suffix(".json"), path.parent, path.parent.parent]
    assert [one.stat().st_mode & 0o777 for one in made] == [0o644, 0o644, 0o755, 0o755]


def test_a_stricter_mask_is_kept(path, source):
    before = os.umask(0o077)
    try:
        source.get(path)
    finally:
        os.umask(before)
    assert [one.stat().st_mode & 0o777 for one in (path, path.parent)] == [0o600, 0o700]


def test_a_folder_where_everybody_writes_is_not_read(path, source, lines):
    source.get(path)
    path.parent.chmod(0o777)
    with pytest.raises(LiberoError, match="writable by every user: chmod"):
        check_trusted(path.parent)
    for _ in range(2):
        assert_same(source.get(path))
    assert source.made == 3 and len(lines()) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes files of others")
@pytest.mark.parametrize(
    ("mode", "owner", "trusted"), [(0o1777, 12345, False), (0o755, 0, False), (0o755, 12345, True)]
)
def test_a_folder_of_another_user_is_read_where_the_cache_is_theirs(path, source, mode, owner, trusted):
    make_cache_folder(path.parent)
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


def test_a_result_about_models_that_is_damaged_is_found_again(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    (tmp_path / "models").mkdir()
    found = published.check_folder(tmp_path / "models")
    (file,) = (tmp_path / "cache" / "assets_checked").iterdir()
    file.write_text(file.read_text().replace(found.digest, "0" * len(found.digest)))
    published.check_folder.cache_clear()
    assert published.check_folder(tmp_path / "models") == found


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


@pytest.mark.parametrize(
    ("text", "message"),
    [("assets: 5", r"config.yaml:1: assets is 5; expected a valid string"), ("- a", "expected an object")]
    + [
        ("assets: /x\nassets: /y", "config.yaml:2"),
        ("assets: [1", "not valid YAML"),
        ("a: &x [*x]", "aliases"),
    ],
)
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
    for content in (store.__file__, None):
        store.packaged_states.cache_clear()
        path.write_bytes(Path(content).read_bytes() if content else b"")
        with pytest.raises(
            BrokenFileError, match=r"libero_spatial\.npz is not a file of arrays .* install the package again"
        ):
            store.packaged_states("libero_spatial")
    atomic_write_npz(path, {"x": np.zeros((2, 3))})
    with pytest.raises(BrokenFileError, match="no digest of x"):
        store.packaged_states("libero_spatial")
    store.packaged_states.cache_clear()


def test_truncated_caches_of_meshes_stop_no_model(tmp_path, monkeypatch, lines):
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "ball.obj"
    trimesh.creation.icosphere(3).export(file)
    sources = ((simplify.MeshSource("ball", str(file), (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),),)
    found = []
    for size in (None, 500):
        for cached in (tmp_path / "cache").glob("meshes/*.npz"):
            cached.write_bytes(cached.read_bytes()[:size])
        simplify.merge_and_simplify.cache_clear()
        simplify._simplified.cache_clear()
        merged = simplify.merge_and_simplify("ball", "ball", sources, 300)
        found.append([*merged[0], *simplify._simplified(str(file), (1.0, 1.0, 1.0), 300)])
    assert all((before == after).all() for before, after in zip(*found, strict=True))
    assert len(found[0][1]) <= 300 and len(lines()) == 2  # one for each file


@pytest.mark.sim
@pytest.mark.parametrize("how", ["truncated", "not finite", "of another model", "without a checksum"])
def test_broken_initial_states_are_generated_again(tmp_path, monkeypatch, lines, how):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    (tmp_path / "task.bddl").write_text(get_task("libero_spatial/0").bddl_text)
    task = read_task(tmp_path / "task.bddl")
    scene = build_scene(task.problem)
    width = 1 + scene.model.nq + scene.model.nv + 7 * len(scene.fixtures)
    states = np.random.default_rng(0).normal(size=(50, width))
    monkeypatch.setattr(store, "generate_init_states", lambda *_: states)
    store.load_init_states(task, scene)
    (path,) = (tmp_path / "cache" / "init_states").iterdir()
    if how == "truncated":
        path.write_bytes(path.read_bytes()[:300])
    elif how == "not finite":
        atomic_write_npz(path, {"states": np.full((50, width), np.nan)})
    elif how == "of another model":
        atomic_write_npz(path, {"states": states[:, 1:]})
    else:
        np.savez(path, states=states * np.nan)
    assert (store.load_init_states(task, scene) == states).all()
    assert len(lines()) == 1
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


def test_functions_are_compiled_where_nothing_can_be_cached(tmp_path, function, lines, monkeypatch):
    (tmp_path / "compiled").write_text("no folder")
    assert [compilation.compiled(function)(x) for x in (1, 2)] == [2, 4]
    (line,) = lines()
    assert "Set NUMBA_CACHE_DIR" in line


def test_functions_are_compiled_where_the_disk_is_full(function, lines, monkeypatch):
    made = compilation.compiled(function)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert made(1) == 2
    assert "No space left on device" in lines()[0]


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


PROGRAM = """
import sys
from libero_env.storage import cached_arrays
from pathlib import Path
import numpy as np
sys.stdin.readline()
print(cached_arrays(Path(sys.argv[1]), lambda: {"a": np.arange(200_000.0)}, lambda found: True)["a"].sum())
"""


def test_processes_that_start_together_share_an_empty_cache(path):
    command = [sys.executable, "-c", PROGRAM, str(path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(command, **pipes) for _ in range(10)]
    for process in processes:  # all are past their imports
        process.stdin.write("\n")
        process.stdin.flush()
    for process in processes:
        out, errors = process.communicate(timeout=120)
        assert (process.returncode, float(out), errors) == (0, 200_000 * 199_999 / 2, "")
    assert [file.name for file in path.parent.iterdir()] == ["file.npz"]


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
