"""Paths: importing neither writes nor prompts; files are written when their path is requested."""

import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from libero._adapters import files
from libero.libero import benchmark, get_default_path_dict, get_libero_path, set_libero_default_path
from libero.libero.benchmark.libero_suite_task_map import libero_task_map
from libero_env.assets.pack import chosen_assets, pack_of
from libero_env.curating.curate import find_demo_files
from libero_env.demos.config import DemoConfig, Variation
from libero_env.demos.generate import demo_path
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.init_states.pickles import read_states, write_states
from libero_env.tasks import bddl, get_suite


def test_configured_paths(tmp_path, monkeypatch):
    import libero.libero

    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path / "config"))
    assert libero.libero.libero_config_path == str(tmp_path / "config")
    assert libero.libero.config_file == str(tmp_path / "config" / "config.yaml")
    set_libero_default_path(tmp_path / "here")
    assert get_default_path_dict(tmp_path / "here")["init_states"] == str(tmp_path / "here" / "init_files")
    with pytest.warns(UserWarning, match=r"here/bddl_files, as .*config.yaml configures, does not exist"):
        assert get_libero_path("bddl_files") == str(tmp_path / "here" / "bddl_files")
    with pytest.raises(UnknownNameError, match="Did you mean 'bddl_files'"):
        get_libero_path("bddl_file")
    with open(libero.libero.config_file, "a") as file:
        file.write("robot: robosuite-1.4.1\n")
    set_libero_default_path()
    assert Path(libero.libero.config_file).read_text() == "robot: robosuite-1.4.1\n"
    assert get_libero_path("bddl_files") == get_default_path_dict()["bddl_files"]
    monkeypatch.delenv("LIBERO_CONFIG_PATH")
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path / "none"))
    with pytest.warns(UserWarning, match="none, the default, does not exist"):
        get_libero_path("datasets")


def test_task_files_are_those_of_the_suites():
    root = Path(get_libero_path("bddl_files"))
    for name in benchmark.libero_suites:
        suite = benchmark.get_benchmark(name)()
        for i, task in enumerate(suite.tasks):
            path = root / task.problem_folder / task.bddl_file
            assert str(path) == suite.get_task_bddl_file_path(i)
            assert path.is_file()
        assert len((root / name / "tasks_info.txt").read_text().split()) == suite.n_tasks
    assert bddl.read(path).goal == benchmark.get_native_task(f"{name}/{i}").problem.goal


def test_init_state_files_are_read_by_torch():
    torch = pytest.importorskip("torch")
    task = benchmark.get_benchmark("libero_object")().get_task(4)
    path = Path(get_libero_path("init_states"), task.problem_folder, task.init_states_file)
    assert (torch.load(path, weights_only=False) == read_states(path)).all()


def test_a_bare_torch_load_reads_arrays(tmp_path):
    torch = pytest.importorskip("torch")
    rows = np.arange(6.0).reshape(2, 3)
    write_states(tmp_path / "a.pruned_init", rows)
    torch.save({"S_conf_mat": rows, "L_fwd": np.float64(2.0), "n": np.int64(3)}, tmp_path / "result.pt")
    torch.serialization.clear_safe_globals()
    with pytest.raises(Exception, match="weights_only"):
        torch.load(tmp_path / "a.pruned_init")
    get_libero_path("benchmark_root")
    assert (torch.load(tmp_path / "a.pruned_init") == rows).all()
    stored = torch.load(tmp_path / "result.pt")
    assert (stored["S_conf_mat"] == rows).all() and stored["L_fwd"] == 2.0


def test_recordings_are_linked_where_the_original_has_them(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path))
    suite = benchmark.get_benchmark("libero_object")()
    name = suite.get_task_demonstration(0)
    folders = [tmp_path / "libero_object" / f for f in ("128x128-seed0-expert9", "256x256-seed0-expert9")]
    for number, folder in enumerate(folders):
        folder.mkdir(parents=True)
        (folder / Path(name).name).write_text(str(number))
    found = Path(get_libero_path("datasets"), name)
    assert found.is_symlink() and found.read_text() == "0", "images of 128 pixels come first"
    newer = tmp_path / "libero_object" / "128x128-seed0-expert10"
    newer.mkdir()
    (newer / Path(name).name).write_text("newer")
    get_libero_path("datasets")
    assert found.read_text() == "newer"
    task = get_suite("libero_object").tasks[0]
    variations = [Variation(reserved=reserved) for reserved in (False, True)]
    default, reserved = (demo_path(tmp_path, DemoConfig(task, variation=v)) for v in variations)
    reserved.parent.mkdir()
    with h5py.File(reserved, "w") as file:
        file.create_group("data").attrs["variation"] = json.dumps({"reserved": True})
    get_libero_path("datasets")
    assert found.read_text() == "newer", "policies are evaluated from those states"
    default.parent.mkdir()
    default.write_text("as scripts expect them")
    os.utime(default.parent, (0, 0))
    get_libero_path("datasets")
    assert found.read_text() == "as scripts expect them"
    files = sorted((*(f / Path(name).name for f in (*folders, newer)), default, reserved))
    assert sorted(find_demo_files([tmp_path])) == sorted(find_demo_files([files[0], tmp_path])) == files
    found.unlink()
    found.write_text("a file of the user's")
    get_libero_path("datasets")
    assert found.read_text() == "a file of the user's"
    (tmp_path / "blob").write_text("a link of the user's, as Hugging Face's cache has them")
    found.unlink()
    found.symlink_to("../blob")
    assert Path(get_libero_path("datasets"), name).read_text().startswith("a link of the user's")
    for target in ("/mnt/elsewhere/x.hdf5", "/data/my-seed-study/x.hdf5"):  # a disk that is not there
        found.unlink()
        found.symlink_to(target)
        get_libero_path("datasets")
        assert found.readlink() == Path(target)


def test_init_states_of_a_configured_folder(tmp_path, monkeypatch):
    rows = np.arange(12.0).reshape(3, 4)
    task = benchmark.get_benchmark("libero_goal")().get_task(2)
    write_states(tmp_path / "init_files" / task.problem_folder / task.init_states_file, rows)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    set_libero_default_path(tmp_path)
    assert (benchmark.get_benchmark("libero_goal")().get_task_init_states(2) == rows).all()


def test_benchmarks():
    assert set(benchmark.get_benchmark_dict()) >= {*benchmark.libero_suites, "libero_100"}
    assert benchmark.get_benchmark("LIBERO_Spatial") is benchmark.LIBERO_SPATIAL
    with pytest.raises(UnknownNameError, match="libero_goal"):
        benchmark.get_benchmark("libero_goals")
    ordered = benchmark.LIBERO_10(task_order_index=5)
    assert sorted(ordered.get_task_names()) == sorted(libero_task_map["libero_10"])
    assert ordered.get_task_names() == [libero_task_map["libero_10"][i] for i in benchmark.task_orders[5]]
    assert benchmark.LIBERO_100().n_tasks == 100
    with pytest.raises(UnknownNameError, match="task order"):
        benchmark.LIBERO_90(1)


def test_a_user_defined_benchmark(monkeypatch):
    names, maps = libero_task_map["libero_spatial"][:3], benchmark.task_maps
    monkeypatch.setitem(maps, "mine", {name: maps["libero_spatial"][name] for name in names})

    @benchmark.register_benchmark
    class Mine(benchmark.Benchmark):
        def __init__(self, task_order_index=0):
            super().__init__(task_order_index)
            self.name = "mine"
            self._make_benchmark()

    assert benchmark.get_benchmark("mine")().get_task_names() == names
    with pytest.raises(UnknownNameError, match="task order of mine 5. Valid: 0"):
        Mine(5)  # the published orders are of ten tasks


@pytest.fixture
def fresh_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    monkeypatch.setattr(files, "_checked", set())
    return tmp_path / "cache"


@pytest.mark.parametrize("key", ["bddl_files", "init_states"])
def test_generated_files_that_are_damaged_are_written_again(fresh_cache, monkeypatch, caplog, key):
    root = Path(get_libero_path(key))
    paths = sorted(path for path in root.rglob("*.*") if path.is_file() and path.name != ".complete")
    contents = [path.read_bytes() for path in paths]
    paths[0].write_bytes(contents[0][:20])
    paths[1].unlink()
    paths[2].write_bytes(b"of my own")
    monkeypatch.setattr(files, "_checked", set())  # as in another process
    assert get_libero_path(key) == str(root)
    assert [path.read_bytes() for path in paths] == contents
    assert paths[2].with_name(f"{paths[2].name}.changed").read_bytes() == b"of my own"
    assert [message.split(" has changed")[0] for message in caplog.messages] == [str(paths[0]), str(paths[2])]


def test_a_cache_of_task_files_that_cannot_be_written_is_one_line(fresh_cache):
    fresh_cache.write_text("a file")
    with pytest.raises(LiberoError, match=r"cannot be written there \(Not a directory\); set LIBERO_CACHE"):
        get_libero_path("bddl_files")


def test_folders_of_a_checkout_that_is_gone_lead_to_the_generated_files(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    monkeypatch.delenv("LIBERO_ASSETS", raising=False)
    monkeypatch.setattr("libero.libero._noted", set())
    (tmp_path / "libero" / "assets").mkdir(parents=True)
    keys = {"bddl_files": "libero/libero/bddl_files", "init_states": "libero/libero/init_files"}
    paths = {key: str(tmp_path / "gone" / path) for key, path in keys.items()}
    paths["assets"] = str(tmp_path / "libero" / "assets")
    (tmp_path / "config.yaml").write_text("".join(f"{key}: {path}\n" for key, path in paths.items()))
    for key in keys:
        for _ in range(2):
            assert any(Path(get_libero_path(key)).iterdir())
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["bddl_files", "init_states"]
    assert chosen_assets().value == paths["assets"] and pack_of(chosen_assets()).name == "builtin"


def test_a_suite_that_is_only_a_list_of_names(monkeypatch, tmp_path):
    class Mine(benchmark.Benchmark):
        name = "mine"

    assert benchmark.libero_task_map is libero_task_map
    monkeypatch.setitem(libero_task_map, "mine", ["open_the_box"])
    suite = Mine()
    suite._make_benchmark()
    assert suite.get_task_names() == ["open_the_box"] and suite.get_task(0).language == "open the box"
    with pytest.raises(LiberoError, match=r"mine/open_the_box\.pruned_init: no such file"):
        suite.get_task_init_states(0)
    Mine.name = "other"
    with pytest.raises(UnknownNameError, match=r"suite.*mine"):
        Mine()._make_benchmark()
