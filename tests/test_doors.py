"""What is loaded by name: doors of the package, and those by which installed packages enter."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from libero_env.doors import doors, enter
from libero_env.storage import read_yaml

ROOT = Path(__file__).parents[1]
PACKAGE = """
import mujoco
from libero_env.objects import ObjectModel
from libero_env.perturbations import Kind
from libero_env.sim.appearance import Appearance

def near(view, one, other, far: float):
    return abs(view.body_pos(one) - view.body_pos(other)).max() < far

def red_cube():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="main")
    body.add_geom(name="g0", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0.05, group=0)
    return ObjectModel("red_cube", spec, bottom_offset=(0, 0, -0.02), top_offset=(0, 0, 0.02))

plain = Kind("plain", "appearance", "", 1.0, "nothing changes", lambda amount, rng, scene: Appearance())
"""
TASK = """
scene: floor
objects: [red_cube, plate]
place: {red_cube_1: [0, 0], plate_1: [0.2, 0]}
goal: Near red_cube_1 plate_1 0.05
language: bring the cube near the plate
"""
USE = """
from libero_env import BatchEnv
from libero_cli.main import main
assert main(["tasks", "lint", "near.yaml"]) == 0
with BatchEnv("near.yaml", 2, cameras=(), perturb="plain=1") as env:
    assert env.reset(seed=0)[1]["progress"].tolist() == [[False], [False]]
    assert env.atoms == ("(Near red_cube_1 plate_1 0.05)",)
"""


@pytest.mark.sim
def test_what_an_installed_package_offers_reaches_every_command(tmp_path):
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    points = {"predicates": "Near = mine:near", "objects": "red_cube = mine:red_cube"}
    points["kinds"] = "plain = mine:plain"
    (info / "entry_points.txt").write_text("".join(f"[libero.{k}]\n{v}\n" for k, v in points.items()))
    (tmp_path / "mine.py").write_text(PACKAGE)
    (tmp_path / "near.yaml").write_text(TASK)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(tmp_path)))}
    done = subprocess.run([sys.executable, "-c", USE], env=env, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


ORDINARY = """
import sys
from libero_env import LiberoEnv
with LiberoEnv("libero_goal/3", camera_size=(16, 16)) as env:
    env.reset(options={"init_state": 0})
    env.step([0.0] * 7)
print(*sorted(sys.modules))
"""


@pytest.mark.sim
def test_an_ordinary_episode_enters_no_room(tmp_path):
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    rooms = [name for contract in tool["contracts"] for name in contract.get("protected_modules", ())]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", ORDINARY]
    loaded = subprocess.check_output(command, env=env, cwd=tmp_path, text=True).split()
    assert "libero_env.envs.batch" in loaded and "libero_env.perturbations" in rooms
    assert [name for name in loaded if name.startswith(tuple(rooms))] == []


@pytest.mark.parametrize("kind", read_yaml("doors.yaml"))
def test_every_door_leads_somewhere(kind):
    for name in doors(kind):
        assert callable(enter(kind, name))
