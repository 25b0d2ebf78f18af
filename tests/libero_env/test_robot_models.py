"""The robot's model files: of an installed robosuite, or fetched once from a package index, or one line."""

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import mujoco
import pytest

from libero_cli.main import main
from libero_env import health
from libero_env.assets import robot
from libero_env.assets.pack import BuiltinPack, problems
from libero_env.errors import MissingPackageError

ROOT = Path(__file__).parents[2]
# Python runs `sitecustomize.py` at start, in this process and in the workers that it spawns.
SITE = """
import importlib.util
HIDDEN = "robosuite", "pip"
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in HIDDEN else find_spec(name, package)
"""


def compiled() -> list[bytes]:
    spec = mujoco.MjSpec()
    robot.add_panda(spec, (0.0, 0.0, 0.0), detailed=True)
    mount = robot.load_robosuite("mounts/rethink_mount.xml")
    spec.attach(mount, prefix="mount0_", frame=spec.worldbody.add_frame())
    model = spec.compile()
    fields = ("geom_type", "geom_pos", "geom_size", "mesh_vert", "mesh_face", "body_mass", "site_pos")
    return [model.names, *(getattr(model, field).tobytes() for field in fields)]


@pytest.fixture(scope="module")
def published():
    """Files of the robot by their names in robosuite 1.4, and the arm that they make."""
    found = {name: path.read_bytes() for name, path in robot._files(robot.robot_assets()).items()}
    return found, compiled()


@pytest.fixture
def index(published, tmp_path, monkeypatch):
    """Make a package index that has one wheel, in place of the network's, for a process without robosuite."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "robosuite" else find(name))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    robot.robot_assets.cache_clear()

    def make(change=lambda name, content: (name, content)):
        with zipfile.ZipFile(tmp_path / "robosuite-1.4.1-py3-none-any.whl", "w") as wheel:
            for name, content in map(change, *zip(*published[0].items(), strict=True)):
                wheel.writestr(f"robosuite/models/assets/{name}", content)
            info = "robosuite-1.4.1.dist-info"
            wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: robosuite\nVersion: 1.4.1\n")
            tags = "Wheel-Version: 1.0\nGenerator: t\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
            wheel.writestr(f"{info}/WHEEL", tags)
            wheel.writestr(f"{info}/RECORD", "")
        return tmp_path / "robosuite-1.4.1-py3-none-any.whl"

    yield make
    robot.robot_assets.cache_clear()


@pytest.mark.sim
def test_the_files_are_fetched_once(index, published, capsys):
    wheel = index()
    assert main(["assets", "install", "robot"]) == 0
    folder = robot.robot_cache()
    assert capsys.readouterr().out == f"{folder}: complete\n"
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} == set(published[0])
    assert compiled() == published[1] and health.check_robot_models().detail == str(folder)
    wheel.unlink()
    robot.robot_assets.cache_clear()
    assert robot.robot_assets() == folder
    (folder / "robots/panda/robot.xml").write_text("<mujoco/>")  # then it is not used
    robot.robot_assets.cache_clear()
    with pytest.raises(MissingPackageError, match="cannot be fetched"):
        robot.robot_assets()


@pytest.mark.sim
def test_the_files_of_robosuite_1_5_make_the_same_arm(published, tmp_path, monkeypatch):
    link, name = b'<body name="link0" pos="0 0 0">', "robots/panda/robot.xml"
    assert link in published[0][name]
    later = published[0][name].replace(b"\r", b"")
    later = later.replace(link, link + b'<site name="right_center" size="0.01"/>')
    for file, content in {**published[0], name: later}.items():
        target = tmp_path / "robosuite/models/assets" / file.replace("mounts", "bases", 1)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    (tmp_path / "robosuite/__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "robosuite", raising=False)
    assert robot.installed_robot() is None  # a model that no release has
    monkeypatch.setattr(robot, "_MODELS", dict.fromkeys(robot._MODELS, _Anything()))
    robot.robot_assets.cache_clear()
    assert robot.robot_assets().is_relative_to(tmp_path) and compiled() == published[1]
    robot.robot_assets.cache_clear()


class _Anything:
    def __contains__(self, digest: str) -> bool:
        return True


def half(wheel: Path) -> None:
    wheel.write_bytes(wheel.read_bytes()[: wheel.stat().st_size // 2])


@pytest.mark.parametrize(("change", "after", "message"), [
    (lambda name, content: (name, content), half, "cannot be fetched (ERROR: "),
    (lambda name, content: (name, content), Path.unlink, "cannot be fetched (ERROR: No matching distribution found"),
    (lambda name, content: (name, content + b" "), lambda wheel: None, "package index has other ones"),
])  # fmt: skip
def test_what_cannot_be_fetched_leaves_nothing(change, after, message, index, capsys):
    after(index(change))
    assert main(["assets", "install", "robot"]) == 2
    err = capsys.readouterr().err.strip()
    assert message in err and "\n" not in err
    assert not list(robot.robot_cache().parent.glob("*robosuite-1.4.1/"))
    finding = health.check_robot_models()
    assert not finding.ok and finding.remedy == "libero assets install robot"


@pytest.mark.sim
def test_the_check_of_assets_reports_it(index):
    (line,) = problems(BuiltinPack())
    assert line.startswith("robot: the robot's model files are missing")


COMMANDS = """
import contextlib, io, runpy, sys
for words in sys.argv[1].splitlines():
    sys.argv[:], said = words.split(), io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as ended:
        print(ended.code, said.getvalue().splitlines()[-1])
    sys.stderr.write(said.getvalue())  # where no traceback may be
"""


@pytest.mark.sim
@pytest.mark.slow
def test_commands_end_with_one_line(tmp_path):
    cli, out = ROOT / "libero_cli/__main__.py", tmp_path / "out"
    commands = [
        f"{cli} tasks init-states libero_object",
        f"{cli} tasks certify libero_object/0 --out {out}",
        f"{cli} tasks certify libero_object/0 --jobs 2 --out {out}",
        f"{cli} tasks preview libero_object/0 --out {out}/preview.png",
        f"{cli} demos generate --benchmark libero_object --n 1 --workers 1",
        f"{cli} demos generate --benchmark libero_object --n 1 --workers 2",
        f"{ROOT / 'train.py'} preset=smoke runs_dir={out}",
    ]
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    own = {"PYTHONPATH": path, "LIBERO_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1", "PATH": ""}
    words, env = [sys.executable, "-c", COMMANDS, "\n".join(commands)], os.environ | own
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == len(commands) and all("2 error: this environment (" in line for line in lines), lines
    assert all("has no pip, and there is no uv; " in line for line in lines), lines
    assert not out.exists()
