"""The `libero` command: its output, and one clear line on errors."""

import contextlib
import importlib.util
import json
import re
import subprocess
import sys
from ctypes.util import find_library
from dataclasses import asdict, replace
from functools import partial
from importlib.machinery import PathFinder
from pathlib import Path

import pytest
import yaml

import libero
import libero_env
import libero_eval
import lifelong
from libero_cli import doctor
from libero_cli import main as cli
from libero_env import health, paths
from libero_env.errors import MAX_LISTED, UnknownNameError
from libero_env.health import Finding
from libero_env.tasks import bddl, get_suite, get_task
from lifelong.cli import gpu
from lifelong.cli.runs import check_torch
from tests.harness.demos import episode, write

ROOT = Path(__file__).parents[1]


OPTIONS = yaml.safe_load((ROOT / "tests" / "commands.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("command", OPTIONS)
def test_no_option_is_lost(command, capsys):
    with contextlib.suppress(SystemExit):
        cli.main([*command.split(), "--help"])
    shown = re.findall(r"(?<![\w-])--[\w-]+", capsys.readouterr().out)
    assert set(OPTIONS[command]) <= set(shown)


def test_tasks_are_listed_in_the_asked_order(capsys):
    assert cli.main(["tasks", "list", "libero_object", "--order", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [task.id for task in get_suite("libero_object").order(3)]


def test_without_a_suite_every_task_is_listed_once(capsys):
    assert cli.main(["tasks", "list"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert len(listed) == len(set(listed)) == 130


def test_a_task_is_shown_as_bddl(capsys):
    assert cli.main(["tasks", "show", "libero_object/7"]) == 0
    assert bddl.parse(capsys.readouterr().out) == get_task("libero_object/7").problem


@pytest.mark.parametrize(("argv", "hint"), [
    (["tasks", "list", "libero_objet"], "Did you mean 'libero_object'?"),
    (["tasks", "show", "libero_object/12"], "unknown index of libero_object '12'. Valid: 0 to 9\n"),
    (["tasks", "list", "libero_object", "--order", "30"], "libero_object 30. Valid: 0 to 20\n"),
    (["tasks", "init-states", "a.yaml", "--jobs", "2"], "--jobs cannot be used with a file without --out"),
    (["doctor", "--gl", "--gpu"], "--gl and --gpu each check one thing only; give one of them"),
    (["eval", "expert", "--suite", "libero_goa"], "Did you mean 'libero_goal'?"),
    (["eval", "nowhere", "--suite", "libero_goal"], "nowhere does not exist; give the directory of a run"),
    (["diagnose", "nowhere"], "nowhere does not exist; give the directory of a run"),
    (["demos", "info", "/nonexist", "tests"], "/nonexist does not exist; give demonstration files"),
])  # fmt: skip
def test_errors_are_one_line_and_a_status(argv, hint, capsys):
    assert cli.main(argv) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and hint in err and err.count("\n") == 1


def test_a_list_of_many_names_is_cut(capsys):
    assert cli.main(["tasks", "show", "nope"]) == 2
    assert len(capsys.readouterr().err) < 300, "ranges of indices, not 130 names"
    cut = str(UnknownNameError("object", "o7", [f"o{i}" for i in range(100, 200)]))
    assert cut.endswith(f"o{99 + MAX_LISTED}, ... (100 in all)") and cut.count(",") == MAX_LISTED


@pytest.mark.parametrize(("inside", "shown"), [("er/bc_seed1", "*/*"), ("one", "*"), ("a/er/one", "*/*/*")])
def test_a_folder_of_runs_is_no_run(inside, shown, tmp_path, capsys):
    for name in ("", "_b"):
        (tmp_path / f"{inside}{name}").mkdir(parents=True)
        (tmp_path / f"{inside}{name}" / "results.jsonl").write_text("")
    assert cli.main(["report", str(tmp_path)]) == 2
    told = f"error: {tmp_path} is not a run: it holds 2, in {tmp_path}/{shown}; write libero report {tmp_path}/{shown}"
    assert capsys.readouterr().err == f"{told}\n"


@pytest.fixture
def demo_file(tmp_path) -> Path:
    one = replace(episode(0, steps=4, size=8), attrs={"failed_attempts": 2})
    (tmp_path / "suite").mkdir()
    return write(tmp_path / "suite" / "a_demo.hdf5", [one, one])


def test_demonstrations_are_described_and_checked(demo_file, tmp_path, capsys):
    assert cli.main(["demos", "info", str(tmp_path)]) == 0
    told = f"{demo_file}: 2 demonstrations, 8 steps, 8x8 pixels, failed attempts: 4, "
    assert told in capsys.readouterr().out
    cut = demo_file.with_name("cut_demo.hdf5")
    cut.write_bytes(demo_file.read_bytes()[:2000])
    assert cli.main(["demos", "check", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert f"ok    {demo_file}: 2 demonstrations, 4-4 steps (mean 4), " in out
    assert f"FAIL  {cut}: not a complete HDF5 file" in out


def test_absent_demonstrations_are_an_error(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path / "none"))
    for command in ("info", "check"):
        assert cli.main(["demos", command]) == 2
        assert "no demonstrations in" in capsys.readouterr().err


def test_unknown_command_lists_the_valid_ones(capsys):
    assert cli.main(["tsaks"]) == 2
    message = capsys.readouterr().err
    assert "Did you mean 'tasks'?" in message and "train" in message


def test_an_unknown_option_names_the_nearest(capsys):
    for words, near in (("eval expert --suites a", "--suite"), ("tasks list --quite", "--quiet")):
        with pytest.raises(SystemExit) as ended:
            cli.main(words.split())
        assert ended.value.code == 2
        assert f"Did you mean '{near}'? see libero" in capsys.readouterr().err


def test_bash_completes_commands_and_options(capsys):
    assert cli.main(["completion"]) == 0
    completion = capsys.readouterr().out
    for words, expected in (
        ("bo", {"board"}),
        ("tasks l", {"list", "lint"}),
        ("compare a b --g", {"--group", "--gate"}),
        ("eval --q", {"--quiet"}),
        ("eval fi", set()),
    ):
        listed = " ".join(f"'{word}'" for word in words.split())
        ask = f'COMP_WORDS=(libero {listed}); COMP_CWORD={len(words.split())}; _libero; echo "${{COMPREPLY[@]}}"'
        command = ["bash", "-c", f"{completion}\n{ask}"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        assert set(done.stdout.split()) == expected and not done.stderr


def test_doctor_reports_what_is_broken_and_how_to_fix_it(monkeypatch, capsys):
    broken = Finding("GL", "no picture", False, "install one")
    minor = Finding("demonstrations", "none", False, "make some", essential=False)
    monkeypatch.setattr(doctor, "examine_gpu", lambda: [minor])
    assert cli.main(["doctor", "--gpu"]) == 0
    assert "note  demonstrations:" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "examine_gpu", lambda: [minor, broken])
    assert cli.main(["doctor", "--gpu"]) == 1
    out = capsys.readouterr().out
    assert "FAIL  GL:" in out and "-> install one" in out
    assert cli.main(["doctor", "--gpu", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] is False and found["findings"] == [asdict(minor), asdict(broken)]


@pytest.mark.sim
def test_doctor_renders_a_frame_and_knows_the_device(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    finding = health.check_gl()
    assert finding.ok and " ms" in finding.detail, finding
    assert check_torch().ok and "threads" in check_torch().detail


def test_doctor_survives_a_machine_without_gl(monkeypatch):
    for name, said in (
        ("MUJOCO_GL", "MUJOCO_GL=vulkan is not a backend; valid: egl, osmesa, glfw"),
        ("PYOPENGL_PLATFORM", "PYOPENGL_PLATFORM=vulkan excludes egl; valid: egl"),
    ):
        with monkeypatch.context() as environment:
            environment.setenv(name, "vulkan")
            finding = health.check_gl()
        assert not finding.ok and said in finding.detail and finding.remedy == f"unset {name}"
    for probe in ("import os; os.abort()", "raise SystemExit(3)", "raise OSError('no libGL')"):
        monkeypatch.setattr(health, "_PROBE", probe)
        finding = health.check_gl()
        assert not finding.ok and finding.detail and "libegl1" in finding.remedy


@pytest.mark.sim
@pytest.mark.skipif(find_library("OSMesa") is None, reason="libosmesa6 is not installed")
def test_where_egl_does_not_work_osmesa_draws(monkeypatch):
    """PyOpenGL and MuJoCo keep what the first backend has chosen."""
    no_egl = """
import importlib
real = importlib.import_module
def without_egl(name, *args, **more):
    module = real(name, *args, **more)
    if name == "mujoco.egl":
        raise ImportError("no EGL")
    return module
importlib.import_module = without_egl
"""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(health, "_PROBE", no_egl + health._PROBE)
    finding = health.check_gl()
    assert finding.ok and finding.detail.startswith("osmesa on"), finding.detail


@pytest.mark.sim
def test_renderers_that_fail_or_draw_on_the_processor_are_told(monkeypatch):
    on_processor = "0 failed, .* on the processor: .*llvmpipe"
    for device, detail in (("H100", "all draw on the GPU"), ("llvmpipe", on_processor)):
        found = json.dumps({"device": device, "milliseconds": 1.0})
        monkeypatch.setattr(health, "_PROBE", f"print({found!r})")
        assert re.match(detail, health.check_renderers(2).detail)
    for probe in ("import os; os.abort()", "print('{\"error\": 1}')"):
        monkeypatch.setattr(health, "_PROBE", probe)
        finding = health.check_renderers(2)
        assert finding.detail.startswith("2 failed") and not finding.ok
        assert "MUJOCO_GL=osmesa" in finding.remedy


def test_doctor_says_in_one_line_that_there_is_no_gpu(monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    assert cli.main(["doctor", "--gpu"]) == 1
    found, remedy = capsys.readouterr().out.splitlines()
    assert found.startswith("FAIL  GPU:") and "nvidia-smi finds none" in found and "without a GPU" in remedy


@pytest.mark.parametrize(("cuda", "ok"), [("12.4", True), ("12.3", False), ("13.0", True), ("", False)])
def test_doctor_reads_the_driver(tmp_path, monkeypatch, cuda, ok):
    tool = tmp_path / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n[ $# = 0 ] && echo '| CUDA Version: {cuda} |' || echo 'H100, 580.126'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    monkeypatch.setattr(health, "check_renderers", lambda n: Finding(f"{n} renderers", ""))
    monkeypatch.setattr(health, "check_warp", lambda device: Finding(device, ""))
    monkeypatch.setattr("lifelong.cli.gpu.examine", lambda: [Finding("torch", "")])
    driver, *others = doctor.examine_gpu()
    titles = [finding.title for finding in others]
    assert driver.ok is ok and driver.detail.startswith("H100, 580.126") and cuda in driver.detail
    assert {"1 renderers", "4 renderers"} < set(titles) and titles[-2:] == ["cuda:0", "torch"]


def test_a_probe_that_fails_or_hangs_is_told_by_its_last_line():
    assert health.run_probe(["-c", "print('found'); print('it')"]) == (True, "it")
    failing = "import sys; print('it'); sys.exit('it differs')"
    assert health.run_probe(["-c", failing]) == (False, "it differs")
    assert health.run_probe(["-c", "import time; time.sleep(60)"], 0.1) == (None, "no answer within 0.1 s")


def test_a_busy_machine_is_noted_and_a_driver_that_computes_for_ever_fails(monkeypatch, capsys):
    monkeypatch.setattr(health, "run_probe", partial(health.run_probe, seconds=0.1))
    assert cli.main(["doctor", "--gl"]) == 0
    assert capsys.readouterr().out.startswith("note  GL:                         no answer within 0.1 s")
    monkeypatch.undo()
    spinning = health._PROBE.partition("\nimport json")[0].replace(f"({health.PROBE_SECONDS},", "(1,")
    monkeypatch.setattr(health, "_PROBE", f"{spinning}\nwhile True: pass")
    assert cli.main(["doctor", "--gl"]) == 1
    assert "no answer within 60 s of computing" in capsys.readouterr().out


@pytest.mark.parametrize("name", [n for n in gpu.PROBES if n != "compiled kernel"])
def test_what_a_gpu_is_asked_for_works_on_the_processor(name, monkeypatch):
    assert gpu.PROBES[name][0]("cpu")
    if name == "training step":
        monkeypatch.setattr(gpu, "TOLERANCE", -1.0)
        with pytest.raises(SystemExit, match="after three training steps the loss is"):
            gpu.train_three_steps("cpu")


@pytest.mark.slow
@pytest.mark.sim
def test_what_compiles_on_a_gpu_compiles_on_the_processor():
    pytest.importorskip("mujoco_warp")
    assert health.check_warp("cpu").detail.endswith("differs from the processor's by 0e+00")
    assert gpu.check("compiled kernel", "cpu").ok


def test_doctor_names_a_package_that_is_missing_or_hides_libero(tmp_path, monkeypatch):
    missing = health.check_package("no-such-package-at-all")
    assert not missing.ok and missing.remedy == "make setup"
    assert health.check_facade().ok
    monkeypatch.setattr(health, "find_distribution", lambda name: name == "hf-libero")
    finding = health.check_facade()
    assert not finding.ok and "hf-libero writes to" in finding.detail
    assert finding.remedy.startswith("pip uninstall hf-libero")
    (tmp_path / "libero").mkdir()
    (tmp_path / "libero" / "__init__.py").touch()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: PathFinder.find_spec(name, [str(tmp_path)]))
    finding = health.check_facade()
    assert not finding.ok and f"{tmp_path / 'libero'} is of hf-libero, and hides" in finding.detail


def test_doctor_checks_folders(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache" / "deep"))
    assert health.check_cache().detail.startswith(f"{tmp_path / 'cache' / 'deep'}, 0 B used")
    assert not health.check_demos().ok and not health.check_demos().essential
    suite = paths.demos_dir() / "libero_object"
    suite.mkdir(parents=True)
    (suite / "a_demo.hdf5").write_bytes(b"x" * 1500)
    assert health.check_demos().detail.startswith("1 files") and "1.5 kB" in health.check_demos().detail
    (tmp_path / "file").touch()
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "file" / "cache"))
    assert not health.check_cache().ok
    (tmp_path / "open" / "meshes").mkdir(parents=True)
    (tmp_path / "open" / "meshes").chmod(0o777)
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "open"))
    assert "meshes is writable by every user: chmod" in health.check_cache().detail
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    (tmp_path / "config.yaml").write_text("assets: [")
    (finding,) = health.check_configured()
    assert not finding.ok and "config.yaml" in finding.detail


def test_doctor_notes_a_gpu_that_is_not_used(monkeypatch):
    monkeypatch.setattr(health, "gpu_name", lambda: "NVIDIA H100, 580.105")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    found = check_torch()
    assert not found.ok and not found.essential and "beside a GPU (NVIDIA H100" in found.detail
    answer = {"backend": "egl", "device": "llvmpipe (LLVM 15)", "milliseconds": 1.0}
    monkeypatch.setattr(health, "_PROBE", f"print({json.dumps(json.dumps(answer))})")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert "beside a GPU" in health.check_gl().detail and not health.check_gl().ok
    answer["device"] = "NVIDIA H100"
    monkeypatch.setattr(health, "_PROBE", f"print({json.dumps(json.dumps(answer))})")
    assert health.check_gl().ok


def test_training_warns_where_a_batch_is_too_large_for_a_cpu(capsys):
    from lifelong.data.settings import DataSettings
    from lifelong.experiment import _warn_of_cpu
    from lifelong.training.settings import FitSettings

    def data(size: int, steps: int) -> DataSettings:
        views = ("agentview_rgb", "eye_in_hand_rgb")
        return DataSettings(demos=1, image_size=size, seq_len=steps, views=views, proprio=("joint_states",))

    _warn_of_cpu(data(128, 10), FitSettings(batch_size=32))
    told = "warning: there is no GPU, and each training step reads 640 images"
    assert capsys.readouterr().err.startswith(told)
    _warn_of_cpu(data(64, 1), FitSettings(batch_size=64))
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    "line", ["train preset=smoke", "demos generate --task libero_goal/3 --for preset=laptop", "report ."]
)
def test_a_package_of_learning_that_is_not_installed_is_one_line(line):
    hide = "import sys; sys.modules[sys.argv.pop(1)] = None"
    program = f"{hide}; from libero_cli.main import main; sys.exit(main())"
    package, extra = ("matplotlib", "eval") if line == "report ." else ("hydra", "train")
    command = [sys.executable, "-c", program, package, *line.split()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"error: {package} is not installed; type pip install 'libero-lifelong[{extra}]'\n"


def test_the_version_is_that_of_all_packages(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"libero-lifelong {libero.__version__}\n"
    assert f"version: {libero.__version__}" in (ROOT / "CITATION.cff").read_text().splitlines()
    assert libero.__version__ == libero_env.__version__ == libero_eval.__version__ == lifelong.__version__
