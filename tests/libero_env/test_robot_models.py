"""Without robosuite's model files, every entry point ends with one line that states what to type."""

import importlib.util
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from libero_env.assets.pack import BuiltinPack, problems
from libero_env.assets.robot import robosuite_assets, robosuite_version
from libero_env.cli import doctor
from libero_env.errors import LiberoError, MissingPackageError
from libero_env.sim import scene
from libero_env.tasks import get_task

ROOT = Path(__file__).parents[2]
REMEDY = "pip install --no-deps robosuite==1.4.1"
MESSAGE = f"the robot's model files are missing: the package robosuite is not installed; type {REMEDY}"
# Python runs `sitecustomize.py` at start, in this process and in the workers that it spawns.
SITE = """
import importlib.metadata, importlib.util
find_spec, version = importlib.util.find_spec, importlib.metadata.version
def absent(name):
    if name == "robosuite":
        raise importlib.metadata.PackageNotFoundError(name)
    return version(name)
importlib.util.find_spec = lambda name, package=None: None if name == "robosuite" else find_spec(name, package)
importlib.metadata.version = absent
"""


@pytest.fixture
def no_robosuite(tmp_path):
    """Environment variables of a process that finds no robosuite."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "LIBERO_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}


def test_a_scene_asks_for_the_package(monkeypatch):
    scene._build_scene.cache_clear()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for call in (robosuite_assets, lambda: scene.build_scene(get_task("libero_goal/0").problem)):
        with pytest.raises(MissingPackageError) as raised:
            call()
        assert str(raised.value) == MESSAGE
        assert isinstance(raised.value, LiberoError)


def test_an_installation_without_its_files_is_replaced(tmp_path, monkeypatch):
    (tmp_path / "robosuite").mkdir()
    (tmp_path / "robosuite" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "robosuite", raising=False)
    with pytest.raises(
        MissingPackageError, match=r"robot.xml does not exist; type pip install .*--force-reinstall"
    ):
        robosuite_assets()


def test_the_error_can_be_sent_by_a_worker():
    error = MissingPackageError("files are missing", REMEDY)
    again = pickle.loads(pickle.dumps(error))  # noqa: S301
    assert str(again) == str(error) and again.remedy == REMEDY


def test_doctor_names_the_remedy(monkeypatch):
    assert doctor.check_robot_models().ok and robosuite_version() == "1.4.1"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    finding = doctor.check_robot_models()
    assert not finding.ok and finding.essential and finding.remedy == REMEDY


@pytest.mark.sim
def test_the_check_of_assets_reports_it(monkeypatch):
    assert problems(BuiltinPack()) == []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert problems(BuiltinPack()) == [f"robot: {MESSAGE}"]


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("command", [
    "-m libero_env.cli tasks init-states libero_object",
    "-m libero_env.cli tasks certify libero_object/0 --out {out}",
    "-m libero_env.cli tasks certify libero_object/0 --jobs 2 --out {out}",
    "-m libero_env.cli tasks preview libero_object/0 --out {out}/preview.png",
    "-m libero_env.cli demos generate --benchmark libero_object --n 1 --workers 1",
    "-m libero_env.cli demos generate --benchmark libero_object --n 1 --workers 2",
    "train.py preset=smoke runs_dir={out}",
])  # fmt: skip
def test_commands_end_with_one_line(command, no_robosuite, tmp_path):
    words = [word.format(out=tmp_path / "out") for word in command.split()]
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=no_robosuite, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].endswith(f"error: {MESSAGE}")
